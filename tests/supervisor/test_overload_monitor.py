"""The overload warning: its limits, its figures and its rate."""

from __future__ import annotations

from jointfit_daemon.outputs.mqtt import LinkHealth
from jointfit_daemon.outputs.payloads import ProcessHealth
from jointfit_daemon.supervisor._overload_monitor import REPEAT_S, OverloadMonitor


def link(sent: int, dropped: int, connects: int = 1) -> LinkHealth:
    return LinkHealth(True, connects, True, [], sent, 0, dropped, 0, 0)


def process(delay_ms: float | None) -> ProcessHealth:
    return ProcessHealth(30.0, None, delay_ms)


def test_overload_is_reported_with_its_figures_once_in_five_minutes() -> None:
    monitor = OverloadMonitor()
    assert monitor.warning(process(1.0), link(100, 0), 0.0) is None
    text = monitor.warning(process(2200.0), link(103, 1400), 10.0)
    assert text is not None
    assert "delay 2200 ms" in text
    assert "1400 of 1403 MQTT messages" in text
    assert monitor.warning(process(2200.0), link(106, 2800), 20.0) is None
    assert monitor.warning(process(2200.0), link(109, 4200), 10.0 + REPEAT_S) is not None


def test_drops_alone_are_reported_but_not_those_of_a_lost_connection() -> None:
    monitor = OverloadMonitor()
    assert monitor.warning(process(None), link(0, 0), 0.0) is None
    assert monitor.warning(process(None), link(0, 500, connects=2), 10.0) is None
    assert monitor.warning(process(1.0), link(90, 510, connects=2), 20.0) is None
    assert monitor.warning(process(1.0), link(100, 600, connects=2), 30.0) is not None
