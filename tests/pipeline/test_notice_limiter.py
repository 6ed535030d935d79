"""Rate limit of notices about wires and clocks: one a minute, with complete totals."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Corrupt, DeviceEvent, DeviceEventKind
from jointfit_daemon.pipeline._notice_limiter import QUIET_NS, NoticeLimiter

S = 1_000_000_000
HZ = 100.0


@given(st.lists(st.tuples(st.integers(0, 3_000_000_000), st.integers(1, 50)), min_size=1))
def test_every_discarded_byte_is_reported_and_at_most_once_a_minute(
    steps: list[tuple[int, int]],
) -> None:
    limiter, now, notices = NoticeLimiter(), 0, []
    for step, size in steps:
        now += step
        notices += limiter.add(now, "S1", Corrupt(size, "checksum"), HZ)
        notices += limiter.due(now)
    notices += limiter.due(now + QUIET_NS)
    assert sum(int(str(n.data["discarded_bytes"])) for n in notices) == sum(s for _, s in steps)
    times = [notice.t_ns for notice in notices]
    assert all(b - a >= QUIET_NS for a, b in itertools.pairwise(times))


def test_gaps_and_corruption_are_limited_separately() -> None:
    limiter = NoticeLimiter()
    first = limiter.add(0, "S1", Corrupt(3, "checksum"), HZ)
    second = limiter.add(1, "S1", DeviceEvent("gap", "counter", {"lost": 2}), HZ)
    assert [n.kind for n in (*first, *second)] == ["wire", "wire"]
    assert second[0].data == {"gaps": 1, "lost": 2}


def test_clock_restart_is_reported_at_once_as_a_warning() -> None:
    (notice,) = NoticeLimiter().add(5, "S1", DeviceEvent("restart", "device time fell by 3 s"), HZ)
    assert (notice.kind, notice.level, notice.text) == (
        "clock",
        "warning",
        "device time fell by 3 s",
    )


def test_repeated_clock_jumps_give_one_notice_a_minute_with_a_count() -> None:
    limiter, notices = NoticeLimiter(), []
    for number in range(40):
        now = number * QUIET_NS // 20
        notices += limiter.due(now)
        notices += limiter.add(
            now, "S1", DeviceEvent("clock", f"jump {number}", {"jump_ms": number}), HZ
        )
    notices += limiter.due(2 * QUIET_NS)
    assert [(n.text, n.data) for n in notices] == [
        ("jump 0", {"jump_ms": 0}),
        ("jump 19 (last of 19 such events)", {"jump_ms": 19, "events": 19}),
        ("jump 39 (last of 20 such events)", {"jump_ms": 39, "events": 20}),
    ]


def test_restarts_and_clock_jumps_are_limited_per_kind_and_device() -> None:
    limiter = NoticeLimiter()
    kinds: list[tuple[str, DeviceEventKind]] = [
        ("S1", "clock"),
        ("S1", "restart"),
        ("S2", "clock"),
        ("S2", "restart"),
    ]
    notices = [limiter.add(1, source, DeviceEvent(kind, "restarted"), HZ) for source, kind in kinds]
    assert [len(each) for each in notices] == [1, 1, 1, 1]


def test_gaps_are_reported_at_start_each_minute_and_at_end() -> None:
    """One sample in 200 of a sensor at 100 Hz is lost for five minutes."""
    limiter, notices = NoticeLimiter(), []
    for tick in range(480):
        now = tick * S
        notices += limiter.due(now)
        if tick % 2 == 0 and tick < 300:
            notices += limiter.add(now, "S1", DeviceEvent("gap", "counter", {"lost": 1}), HZ)
    assert [(n.t_ns // S, n.level, n.text, n.data["lost"]) for n in notices] == [
        (0, "info", "1 sample lost", 1),
        (60, "info", "29 samples lost, in the last 60 s (0.48 %)", 29),
        (120, "info", "30 samples lost, in the last 60 s (0.50 %)", 30),
        (180, "info", "30 samples lost, in the last 60 s (0.50 %)", 30),
        (240, "info", "30 samples lost, in the last 60 s (0.50 %)", 30),
        (300, "info", "30 samples lost, in the last 60 s (0.50 %)", 30),
        (360, "info", "no samples lost for 60 s", 0),
    ]


def test_losses_above_one_percent_are_a_warning() -> None:
    for lost, level in ((60, "info"), (61, "warning")):
        limiter = NoticeLimiter()
        (first,) = limiter.add(0, "S1", DeviceEvent("gap", "counter", {"lost": lost}), HZ)
        limiter.add(S, "S1", DeviceEvent("gap", "counter", {"lost": lost}), HZ)
        (minute,) = limiter.due(60 * S)
        assert [first.level, minute.level] == [level, level]


def test_single_gap_is_reported_once() -> None:
    limiter = NoticeLimiter()
    assert len(limiter.add(0, "S1", DeviceEvent("gap", "counter", {"lost": 1}), HZ)) == 1
    assert [limiter.due(tick * S) for tick in range(1, 200)] == [[]] * 199


def test_counter_jumps_give_one_wire_notice_a_minute() -> None:
    limiter = NoticeLimiter()
    notices = [
        limiter.add(n, "S1", DeviceEvent("counter", f"jumped to {n}"), HZ) for n in range(100)
    ]
    assert [n.kind for each in notices for n in each] == ["wire"]
    (rest,) = limiter.due(61 * S)
    assert (rest.kind, rest.data["events"]) == ("wire", 99)
    assert rest.text == "jumped to 99 (last of 99 such events)"
