"""Fixtures of the tests of `jointfit init`."""

from __future__ import annotations

from functools import cache

import pytest

from jointfit_daemon import driver
from jointfit_daemon.config import _load


@pytest.fixture(autouse=True)
def fast_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search the installed packages for drivers once: a dialogue checks a rig for each answer."""
    monkeypatch.setattr(_load, "find_driver", cache(driver.find_driver))
