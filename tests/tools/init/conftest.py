"""Fixtures that replace the search for installed drivers in the tests of `jointfit init`."""

from __future__ import annotations

from functools import cache

import pytest

from jointfit_daemon import driver
from jointfit_daemon.config import _load
from jointfit_daemon.tools.init import _search


@pytest.fixture(autouse=True)
def fast_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search the installed packages for each driver only once, instead of after each answer."""
    monkeypatch.setattr(_load, "find_driver", cache(driver.find_driver))


@pytest.fixture
def one_driver_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer one driver each for UARTs, CAN and cameras, so that the dialogue asks for no driver."""
    installed = [(name, driver.find_driver(name)) for name in ("natnet", "xbus", "xcdi")]
    monkeypatch.setattr(_search, "installed_drivers", lambda: iter(installed))
