"""The machine as every test finds it: simulator and broker up, the simulator's rig, no service."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from machine import SIM, UNIT, cursor, eventually, give_ports, run, show, write_rig

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def machine() -> Iterator[None]:
    run("systemctl", "stop", UNIT)
    run("systemctl", "reset-failed", UNIT, check=False)
    run("systemctl", "start", "mosquitto", "jointfit-sim")
    eventually((SIM / "rig.toml").is_file, "the simulator is ready")
    give_ports()
    write_rig()
    yield
    run("systemctl", "stop", UNIT)


@pytest.fixture
def since() -> str:
    return cursor()


@pytest.fixture
def service(since: str) -> int:
    """The running service's process id."""
    run("systemctl", "start", UNIT)
    return int(show("MainPID"))
