"""Precision timestamps whose fractions are zero: no time, or a time after twenty frames."""

from __future__ import annotations

from jointfit_protocols.natnet import PrecisionTime


def test_timestamps_of_zeros_have_no_time_and_no_unit() -> None:
    time = PrecisionTime()
    assert {time.ns((0, 0)) for _ in range(30)} == {None}
    assert (time.absent, time.decided) == (30, False)


def test_timestamps_of_whole_seconds_have_a_time_after_twenty_frames() -> None:
    time = PrecisionTime()
    assert {time.ns((second, 0)) for second in range(1, 20)} == {None}
    assert time.ns((20, 0)) == 20_000_000_000
    assert (time.absent, time.decided) == (0, True)
