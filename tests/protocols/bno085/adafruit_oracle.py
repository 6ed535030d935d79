"""Adafruit's packages for BNO08x as oracles, without the hardware layer that they import."""

from __future__ import annotations

import sys
from functools import cache
from types import ModuleType
from typing import Any
from unittest import mock

import pytest


@cache
def adafruit(name: str) -> Any:
    """Return a package of Adafruit; skip the test where it is not installed."""
    busio, micropython = ModuleType("busio"), ModuleType("micropython")
    vars(busio)["UART"] = object
    vars(micropython)["const"] = int
    with mock.patch.dict(sys.modules, busio=busio, micropython=micropython):
        return pytest.importorskip(name, reason="Adafruit's packages are not here")
