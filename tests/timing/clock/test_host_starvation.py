"""Late reads and bursts on a host without CPU time do not count as restarts of a device clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jointfit_daemon.model import TickClock
from jointfit_daemon.timing.clock import DeviceClock

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.timing.clock import Stamp

MS, S = 1_000_000, 1_000_000_000
PERIOD = 10 * MS
START = 7_000 * S
OWN = TickClock(1000, 1 << 32)
SETTLING_S = 8.0
"""Longest permitted settling time of a clock if the host stalls from the start, s. Without stalls,
a clock settles within 3 s.
"""


def read_late(
    stalls_s: Sequence[tuple[float, float]], seconds: float, begin_s: float
) -> NDArray[np.int64]:
    """Return the arrivals, ns, of a device's samples at a host that works and stalls in turn.

    The device sends for `seconds`. The stalls begin at `begin_s`.
    """
    rng = np.random.default_rng(1)
    n = int(seconds * S / PERIOD)
    due = START + np.arange(n) * PERIOD + rng.exponential(3e5, n).astype(np.int64)
    at = START + round(begin_s * S)
    while at < due[-1]:
        for work_s, stall_s in stalls_s:
            asleep = at + round(work_s * S)
            at = asleep + round(stall_s * S)
            late = (due >= asleep) & (due < at)
            due[late] = at + 2_000 * np.arange(np.count_nonzero(late))
    return np.maximum.accumulate(due)


def stamped(arrivals: NDArray[np.int64]) -> tuple[DeviceClock, list[tuple[int, Stamp]]]:
    """Return the clock of a device that is 20 ppm fast, and true instant and stamp of samples."""
    clock, out = DeviceClock(PERIOD), []
    for k, arrival in enumerate(arrivals.tolist()):
        ticks = (k * PERIOD * 1_000_020 // 1_000_000 + 60 * S) // 1000 % (1 << 32)
        stamp = clock.feed_sample(ticks, k % 65536, arrival, OWN)
        out.append((START + k * PERIOD, stamp))
    return clock, out


stalls = st.lists(
    st.tuples(st.floats(0.02, 0.5), st.floats(0.2, 2.0)), min_size=1, max_size=5
)  # fmt: skip
"""Durations of work and stall, s. The work lasts at least two sample periods, so it contains a
punctual sample. Without punctual samples, increasing delays look like a slow clock.
"""


@settings(max_examples=15, deadline=None)
@given(stalls, st.sampled_from([0.0, 6.0]))
@example([(0.01, 2.0)], 6.0)
@example([(0.103515625, 1.0234375)], 0.0)  # delays of 14 ms must not count as jitter
@example([(0.5, 1.0), (0.5, 2.0)], 0.0)  # most samples are late
@example([(0.25, 1.0)], 0.0)  # two bursts do not determine a line to 1 ms
def test_stalls_and_bursts_are_late_data_and_no_restart(
    stalls_s: list[tuple[float, float]], begin_s: float
) -> None:
    clock, out = stamped(read_late(stalls_s, 40.0, begin_s))
    assert clock.epoch == 0
    assert not clock.news
    assert all(abs(stamp.t_ns - true) < MS for true, stamp in out if stamp.synced)
    if begin_s:
        assert all(stamp.synced for _, stamp in out[500:])


def test_a_clock_settles_on_a_starved_host() -> None:
    """The host works for 0.1 s, then stalls for 0.3 to 1.5 s, from the first sample on."""
    _, out = stamped(read_late([(0.1, 0.3), (0.1, 1.5), (0.1, 0.7)], 20.0, 0.0))
    assert all(stamp.synced for _, stamp in out[int(SETTLING_S * S / PERIOD) :])


@pytest.mark.parametrize("seed", range(4))
def test_delivery_stalls_of_varying_length_do_not_move_the_clock(seed: int) -> None:
    """No sample is punctual for ten seconds, because the queue is never empty."""
    rng = np.random.default_rng(seed)
    arrivals = read_late([(100.0, 0.0)], 30.0, 0.0)
    steps = np.abs(np.cumsum(rng.normal(0.0, 25.0 * MS, 1000)))
    arrivals[1000:2000] += (60 * MS + steps).astype(np.int64)
    clock, out = stamped(np.maximum.accumulate(arrivals))
    assert not clock.news
    assert all(abs(stamp.t_ns - true) < MS for true, stamp in out[300:])


def test_burst_from_before_the_start_does_not_settle_the_clock() -> None:
    """The samples of three seconds arrive at once, and one arrival time determines no line."""
    arrivals = read_late([(100.0, 0.0)], 12.0, 0.0)
    arrivals[:300] = START + 3 * S + 2_000 * np.arange(300)
    clock, out = stamped(np.maximum.accumulate(arrivals))
    assert not any(stamp.synced for _, stamp in out[:400])
    assert not clock.news
    assert all(abs(stamp.t_ns - true) < MS for true, stamp in out if stamp.synced)
    assert clock.settled


def test_one_wrong_arrival_time_is_no_restart() -> None:
    """A single sample with an arrival before its measurement is unsynced, without other effects."""
    arrivals = read_late([(100.0, 0.0)], 12.0, 0.0)
    arrivals[800] -= 400 * MS
    clock, out = stamped(arrivals)
    assert clock.epoch == 0
    assert [number for number, (_, stamp) in enumerate(out[300:], 300) if not stamp.synced] == [800]
    stamps = [stamp.t_ns for _, stamp in out]
    assert np.all(np.diff(stamps) > 0)


def test_a_backward_step_of_the_estimate_is_reported_once() -> None:
    """After a long full queue, punctual samples cause one event and some unsynced stamps."""
    arrivals = read_late([(100.0, 0.0)], 30.0, 0.0)
    arrivals[:1500] += 300 * MS
    clock, out = stamped(arrivals)
    assert [news.kind for news in clock.news] == ["clock"]
    stamps = [stamp.t_ns for _, stamp in out]
    assert np.all(np.diff(stamps) > 0)
    assert clock.epoch == 1
    assert all(abs(stamp.t_ns - true) < MS for true, stamp in out[1500:] if stamp.synced)
    assert clock.settled
