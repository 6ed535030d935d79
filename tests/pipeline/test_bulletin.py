"""Notices about wires come at most once a second, and nothing is lost by that."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_daemon.pipeline.bulletin import QUIET_NS, Bulletin


@given(st.lists(st.tuples(st.integers(0, 400_000_000), st.integers(1, 50)), min_size=1))
def test_every_discarded_byte_is_told_and_at_most_once_in_ten_seconds(
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
