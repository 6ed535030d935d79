"""Overload warnings: limits, numbers in the text, rate, and one warning for each cause."""

from __future__ import annotations

from jointfit_daemon.outputs.mqtt import LinkHealth
from jointfit_daemon.supervisor._overload_monitor import (
    REPEAT_S,
    STALL_REPEAT_S,
    OverloadMonitor,
)


def link(sent: int, dropped: int, connects: int = 1) -> LinkHealth:
    return LinkHealth(True, connects, True, [], sent, 0, dropped, 0, 0)


def test_stalls_are_reported_once_a_minute_with_their_number() -> None:
    monitor = OverloadMonitor()
    assert monitor.stall_warning(0.4, 0.0) is None
    text = monitor.stall_warning(4.95, 10.0)
    assert text is not None
    assert text.startswith("gateway: stopped or overloaded for 4950 ms, the data of this time")
    assert text.endswith("or use a faster gateway")

    assert monitor.stall_warning(1.2, 20.0) is None
    assert monitor.stall_warning(2.2, 30.0) is None
    again = monitor.stall_warning(0.7, 10.0 + STALL_REPEAT_S)
    assert again is not None
    assert "for 2200 ms at most, 3 times in the last 60 s," in again


def test_dropped_messages_are_reported_with_their_figures_once_in_five_minutes() -> None:
    monitor = OverloadMonitor()
    assert monitor.drop_warning(link(100, 0), 0.0) is None
    text = monitor.drop_warning(link(103, 1400), 10.0)
    assert text is not None
    assert text.startswith("mqtt: 1400 of 1403 messages dropped")
    assert "lower output_rate_hz" in text
    assert monitor.drop_warning(link(106, 2800), 20.0) is None
    assert monitor.drop_warning(link(109, 4200), 10.0 + REPEAT_S) is not None


def test_messages_dropped_in_a_stall_have_no_warning_beside_that_of_the_stall() -> None:
    monitor = OverloadMonitor()
    assert monitor.drop_warning(link(100, 0), 0.0) is None
    assert monitor.stall_warning(4.95, 5.0) is not None
    assert monitor.drop_warning(link(103, 1400), 10.0) is None
    assert monitor.drop_warning(link(106, 2800), 20.0) is not None


def test_messages_dropped_with_the_connection_have_no_warning() -> None:
    monitor = OverloadMonitor()
    assert monitor.drop_warning(link(0, 0), 0.0) is None
    assert monitor.drop_warning(link(0, 500, connects=2), 10.0) is None
    assert monitor.drop_warning(link(90, 510, connects=2), 20.0) is None
    assert monitor.drop_warning(link(100, 600, connects=2), 30.0) is not None
