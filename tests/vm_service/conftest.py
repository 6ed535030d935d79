"""The machine as every test finds it: simulator and broker up, the simulator's rig, no service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from machine import SIM, UNIT, cursor, eventually, give_ports, run, show, write_rig

if TYPE_CHECKING:
    from collections.abc import Iterator


class TellsAtOnce:
    """Prints why a test failed when it fails: a run that is cut short has no summary."""

    def __init__(self, config: pytest.Config) -> None:
        self._plugins = config.pluginmanager

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            terminal: Any = self._plugins.get_plugin("terminalreporter")
            terminal.write_line(f"\n{report.longreprtext}")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(TellsAtOnce(config), "tells at once")


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
