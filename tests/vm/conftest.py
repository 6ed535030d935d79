"""Fixtures for tests on vcan0, which is up before and after every test."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from jointfit_simulators.wires import PythonCanWire
from tests.vm.vcan_link import LINK, ip


@pytest.fixture(autouse=True)
def vcan_is_up_before_and_after(request: pytest.FixtureRequest) -> Any:
    yield
    if LINK not in {name for _, name in socket.if_nameindex()}:
        ip("add", "dev", LINK, "type", "vcan")
    ip("set", LINK, "up")


@pytest.fixture
def wire() -> Any:
    made = PythonCanWire("socketcan", LINK)
    yield made
    made.unplug()
