"""Import of Adafruit's packages for the BNO08x, with whose results tests compare the codecs.

Substitutes replace the modules for hardware access that the packages import.
"""

from __future__ import annotations

import sys
from functools import cache
from types import ModuleType
from typing import Any
from unittest import mock

import pytest


@cache
def adafruit(name: str) -> Any:
    """Return a package of Adafruit; skip the test if it is not installed."""
    busio, micropython = ModuleType("busio"), ModuleType("micropython")
    vars(busio)["UART"] = object
    vars(micropython)["const"] = int
    with mock.patch.dict(sys.modules, busio=busio, micropython=micropython):
        return pytest.importorskip(name, reason="Adafruit's packages are not here")
