"""Timestamps approach their estimate at a rate of at most 500 ppm, and never decrease."""

from __future__ import annotations

import pytest

from jointfit_daemon.timing.clock._stamps import MonotonicStamps

MS = 1_000_000


def running(period_ns: int = 10 * MS) -> MonotonicStamps:
    """Return timestamps whose last sample has device time 0 and host time 1 s."""
    stamps = MonotonicStamps(period_ns)
    assert stamps.stamp(0, 1000 * MS, 0.0, slew=True) == (1000 * MS, 0)
    assert stamps.offset_ns == 1000 * MS
    return stamps


@pytest.mark.parametrize(
    ("error_ns", "corrected_ns", "step_ns"),
    [
        (5_000, 5_000, 0),  # 500 ppm of 10 ms
        (-5_000, -5_000, 0),
        (5_001, 5_000, 0),
        (-5_001, -5_000, 0),
        (5 * MS, 5_000, 0),
        (-5 * MS, -5_000, 0),
        (5 * MS + 1, 5 * MS + 1, 5 * MS + 1),
        (-5 * MS - 1, -5 * MS - 1, -5 * MS - 1),
    ],
)
def test_an_error_is_slewed_up_to_5_ms_and_stepped_beyond(
    error_ns: int, corrected_ns: int, step_ns: int
) -> None:
    t_ns, step = running().stamp(10 * MS, 1010 * MS + error_ns, 0.0, slew=True)
    assert (t_ns - 1010 * MS, step) == (corrected_ns, step_ns)


def test_there_is_no_offset_before_the_first_sample() -> None:
    assert MonotonicStamps(10 * MS).offset_ns is None


def test_after_a_long_pause_an_error_within_the_slew_rate_is_no_step() -> None:
    hour_ns = 3_600_000 * MS
    slewed = 1800 * MS  # 500 ppm of an hour
    assert running().stamp(hour_ns, 1000 * MS + hour_ns + slewed, 0.0, slew=True)[1] == 0
    beyond = 1000 * MS + hour_ns + slewed + 1
    assert running().stamp(hour_ns, beyond, 0.0, slew=True) == (beyond, slewed + 1)


def test_the_skew_of_the_device_is_no_error() -> None:
    ahead = running().stamp(1000 * MS, 2000 * MS + 700_000, 100e-6, slew=True)
    assert ahead == (2000 * MS + 100_000 + 500_000, 0)


@pytest.mark.parametrize(
    ("passed_ns", "target_ns", "t_ns"),
    [
        (10 * MS, 1000 * MS, 1005 * MS),
        (4 * MS, 1000 * MS, 1002 * MS),
        (50 * MS, 1000 * MS, 1005 * MS),
        (10 * MS, 1008 * MS, 1008 * MS),
    ],
)
def test_before_the_clock_is_synced_samples_are_half_a_period_apart(
    passed_ns: int, target_ns: int, t_ns: int
) -> None:
    assert running().stamp(passed_ns, target_ns, 0.0, slew=False) == (t_ns, 0)


def test_timestamps_increase_after_a_restart_and_without_device_time() -> None:
    stamps = running()
    stamps.last_u = None
    assert stamps.offset_ns is None
    assert stamps.stamp(5, 900 * MS, 0.0, slew=True) == (1000 * MS + 1, 0)
    assert stamps.forward(1000 * MS + 1) == 1000 * MS + 2
    assert stamps.forward(2000 * MS) == 2000 * MS
    assert stamps.stamp(6, 2000 * MS, 0.0, slew=False) == (2000 * MS + 1, 0)
