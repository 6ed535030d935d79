"""Notices about wires and clocks come at most once a minute, and nothing is lost by that."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_daemon.pipeline._notice_limiter import QUIET_NS, Bulletin

S = 1_000_000_000


@given(st.lists(st.tuples(st.integers(0, 3_000_000_000), st.integers(1, 50)), min_size=1))
def test_every_discarded_byte_is_reported_and_at_most_once_a_minute(
    steps: list[tuple[int, int]],
) -> None:
    bulletin, now, told = Bulletin(), 0, []
    for step, size in steps:
        now += step
        told += bulletin.add(now, "S1", Corrupt(size, "checksum"))
        told += bulletin.due(now)
    told += bulletin.due(now + QUIET_NS)
    assert sum(int(str(n.data["discarded_bytes"])) for n in told) == sum(s for _, s in steps)
    times = [notice.t_ns for notice in told]
    assert all(b - a >= QUIET_NS for a, b in itertools.pairwise(times))


def test_gaps_and_corruption_of_one_device_do_not_hide_each_other() -> None:
    bulletin = Bulletin()
    first = bulletin.add(0, "S1", Corrupt(3, "checksum"))
    second = bulletin.add(1, "S1", DeviceEvent("gap", "counter", {"lost": 2}))
    assert [n.kind for n in (*first, *second)] == ["wire", "wire"]
    assert second[0].data == {"gaps": 1, "lost": 2}


def test_a_restarted_clock_is_told_at_once_as_a_warning() -> None:
    (notice,) = Bulletin().add(5, "S1", DeviceEvent("restart", "device time fell by 3 s"))
    assert (notice.kind, notice.level, notice.text) == (
        "clock",
        "warning",
        "device time fell by 3 s",
    )


def test_a_clock_that_jumps_again_and_again_is_one_line_a_minute_with_a_count() -> None:
    bulletin, told = Bulletin(), []
    for number in range(40):
        now = number * QUIET_NS // 20
        told += bulletin.due(now)
        told += bulletin.add(now, "S1", DeviceEvent("clock", f"jump {number}", {"jump_ms": number}))
    told += bulletin.due(2 * QUIET_NS)
    assert [(n.text, n.data) for n in told] == [
        ("jump 0", {"jump_ms": 0}),
        ("jump 19 (the last of 19 such events)", {"jump_ms": 19, "events": 19}),
        ("jump 39 (the last of 20 such events)", {"jump_ms": 39, "events": 20}),
    ]


def test_a_reboot_is_not_hidden_by_jumps_of_the_clock_nor_by_another_device() -> None:
    bulletin = Bulletin()
    kinds = [("S1", "clock"), ("S1", "restart"), ("S2", "clock"), ("S2", "restart")]
    told = [bulletin.add(1, source, DeviceEvent(kind, "anew")) for source, kind in kinds]
    assert [len(notices) for notices in told] == [1, 1, 1, 1]


def test_drop_outs_are_reported_when_they_begin_each_minute_and_when_they_end() -> None:
    """One sample in 200 of a sensor at 100 Hz is lost for five minutes."""
    bulletin, told = Bulletin(), []
    for tick in range(480):
        now = tick * S
        told += bulletin.due(now)
        if tick % 2 == 0 and tick < 300:
            told += bulletin.add(now, "S1", DeviceEvent("gap", "counter", {"lost": 1}))
    assert [(n.t_ns // S, n.level, n.text, n.data["lost"]) for n in told] == [
        (0, "warning", "1 sample lost on the way", 1),
        (60, "warning", "29 samples lost on the way, in the last 60 s", 29),
        (120, "warning", "30 samples lost on the way, in the last 60 s", 30),
        (180, "warning", "30 samples lost on the way, in the last 60 s", 30),
        (240, "warning", "30 samples lost on the way, in the last 60 s", 30),
        (300, "warning", "30 samples lost on the way, in the last 60 s", 30),
        (360, "info", "no sample was lost for 60 s", 0),
    ]


def test_a_single_gap_is_reported_once() -> None:
    bulletin = Bulletin()
    assert len(bulletin.add(0, "S1", DeviceEvent("gap", "counter", {"lost": 1}))) == 1
    assert [bulletin.due(tick * S) for tick in range(1, 200)] == [[]] * 199


def test_jumps_of_a_counter_are_notices_of_the_wire_one_a_minute() -> None:
    bulletin = Bulletin()
    told = [bulletin.add(n, "S1", DeviceEvent("counter", f"jumped to {n}")) for n in range(100)]
    assert [n.kind for notices in told for n in notices] == ["wire"]
    (rest,) = bulletin.due(61 * S)
    assert (rest.kind, rest.data["events"]) == ("wire", 99)
    assert rest.text == "jumped to 99 (the last of 99 such events)"
