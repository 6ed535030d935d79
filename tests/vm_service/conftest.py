"""State of the machine before each test: the simulator and the broker run, the service does not.

The rig of the simulator is installed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from machine import SIM, UNIT, cursor, eventually, give_ports, run, show, write_rig

if TYPE_CHECKING:
    from collections.abc import Iterator


class FailurePrinter:
    """Prints the reason of a failure at once, because an interrupted run has no summary."""

    def __init__(self, config: pytest.Config) -> None:
        self._plugins = config.pluginmanager

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            terminal: Any = self._plugins.get_plugin("terminalreporter")
            terminal.write_line(f"\n{report.longreprtext}")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(FailurePrinter(config), "failure printer")


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
    """Start the service, and return its process id."""
    run("systemctl", "start", UNIT)
    return int(show("MainPID"))
