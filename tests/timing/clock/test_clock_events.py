"""Clock events: choice between restart and jump, sizes in text and data, and limits of the skew."""

from __future__ import annotations

import pytest

from jointfit_daemon.timing.clock import _clock_events as events

S = 1_000_000_000


@pytest.mark.parametrize(
    ("times_ns", "kind", "text", "jump_ms"),
    [
        ((100 * S, S, 3 * S), "restart", "device rebooted: its clock went back from 100.00 s to 1",
         -102_000.0),
        ((100 * S, 5 * S, 3 * S), "restart",
         "device rebooted: its clock went back from 100.00 s to 5.00 s", -98_000.0),
        ((100 * S, 5 * S + 1, 3 * S), "clock", "device clock jumped back by 98000.0 ms", -98_000.0),
        ((100 * S, 0, 0), "restart", "device rebooted: its clock went back from 100.00 s to 0.00 s",
         -100_000.0),
        ((S, S, S), "clock", "device clock jumped back by 1000.0 ms", -1000.0),
        ((S, 4 * S, S), "clock", "device clock jumped ahead by 2000.0 ms", 2000.0),
        ((S, -1, S), "clock", "device clock jumped back by 2000.0 ms", -2000.0),
    ],
)  # fmt: skip
def test_a_small_device_time_is_a_reboot_and_another_a_jump(
    times_ns: tuple[int, int, int], kind: str, text: str, jump_ms: float
) -> None:
    found = events.clock_restart_event(*times_ns)
    assert found.kind == kind
    assert found.text.startswith(text)
    assert found.data == {"jump_ms": jump_ms}


def test_events_have_their_size_in_milliseconds() -> None:
    assert events.early_arrival_event(7_123_456.0).data == {"jump_ms": 7.123}
    assert "ahead by 7.1 ms" in events.early_arrival_event(7_123_456.0).text
    assert events.late_arrival_event(60_123_456.0, 2.0).data == {"jump_ms": -60.123}
    assert "60.1 ms late for 2 s" in events.late_arrival_event(60_123_456.0, 2.0).text
    reset = events.clock_reset_event(2 * S, 30 * S)
    assert (reset.kind, reset.data) == ("restart", {"jump_ms": -28_000.0})
    assert "advanced by 2.00 s in 30.00 s" in reset.text
    assert events.echo_jump_event(8_000_400).data == {"jump_ms": 8.0}
    assert events.estimate_step_event(-6_500_000) == (
        "clock", "clock estimate stepped by -6.5 ms", {"step_ms": -6.5},
    )  # fmt: skip
    late = events.sync_disagreement_event(9_000_000, 5_504_400)
    assert (late.kind, late.data) == ("warning", {"off_ms": 3.496})
    assert "by 3.5 ms" in late.text


@pytest.mark.parametrize(
    ("kind", "limit", "remedy"),
    [("ticks", 500, "tick rate"), ("samples", 500, "rate_hz"), ("echo", 100, "operating system")],
)
def test_a_skew_is_reported_three_standard_deviations_above_its_limit(
    kind: str, limit: int, remedy: str
) -> None:
    for sign in (1.0, -1.0):
        assert events.skew_warning(kind, sign * (limit + 30.0), 10.0) is None
        found = events.skew_warning(kind, sign * (limit + 30.5), 10.0)
        assert found is not None
        assert found.data == {"skew_ppm": sign * (limit + 30.5)}
        assert f"limit {limit} ppm" in found.text
        assert remedy in found.text
