r"""Gait cycles of a leg from the orientation of its shank.

Mid-swing is the peak of the sagittal angular velocity of the shank (Aminian et al. 2002; Salarian
et al. 2004). Initial contact is the end of the forward rotation after mid-swing. At this instant
the shank reaches its largest forward inclination and the foot is farthest in front of the body.
Zeni et al. (2008) detect the same instant with markers. A cycle extends from one initial contact to
the next.

Invariant: cycles do not overlap, contain no gap of the series, and belong to a run of at least
`LEAST_CYCLES` successive cycles of similar duration. If the movement is not walking, the result
contains a reason instead of cycles.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import butter, find_peaks, sosfiltfilt

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.session_data import (
    interpolate_orientations,
    interpolate_values,
    sample_rate_hz,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.session_data import SegmentSeries

LEAST_CYCLES = 3
"""Smallest number of successive cycles that count as walking."""
SWING_RATE = np.radians(100.0)
"""Smallest angular velocity of the shank at mid-swing, rad/s. Walking reaches 200 to 450 deg/s."""
SHORTEST_S, LONGEST_S = 0.6, 2.5
"""Limits of the duration of a cycle, s."""
SWING_SHARE = (0.15, 0.44)
"""Limits of the fraction of a cycle in which the shank rotates forward. The fraction is about 0.3
in walking and 0.5 in the motion of a pendulum.
"""
LEAST_RANGE = np.radians(30.0)
"""Smallest range of the inclination of the shank within a cycle, rad."""
SAME_PACE = 0.3
"""Largest relative difference between the durations of two successive cycles."""
CUTOFF_HZ = 6.0
"""Cut-off of the low-pass filter of the angular velocity, Hz (Winter 2009)."""
_LEAST_HZ = 4.0 * CUTOFF_HZ
"""Lowest sample rate of the shank at which the angular velocity is evaluated, Hz."""
_GRID_HZ = 100.0
"""Highest rate at which the angular velocity is evaluated, Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class GaitCycles:
    """Gait cycles of one leg, or the reason why there are none."""

    segment: str
    """Shank whose orientation determined the cycles."""
    cycles_s: Array
    """Start and end of each cycle (initial contacts), s, shape (n, 2)."""
    refused: str | None
    """Reason why no cycle was found; None if there are cycles."""

    @property
    def durations_s(self) -> Array:
        """Duration of each cycle, s, shape (n,)."""
        durations: Array = self.cycles_s[:, 1] - self.cycles_s[:, 0]
        return durations


@dataclass(frozen=True, slots=True, eq=False)
class CycleCurves:
    """Values of a quantity over the gait cycle, with one row for each cycle."""

    percent: Array
    """Instants, percent of the cycle, shape (m,)."""
    cycles: Array
    """Values of the complete cycles, shape (n, m)."""

    @property
    def mean(self) -> Array:
        """Mean over the cycles, shape (m,)."""
        mean: Array = self.cycles.mean(axis=0)
        return mean

    @property
    def sd(self) -> Array:
        """Standard deviation between the cycles, shape (m,); NaN for a single cycle."""
        if len(self.cycles) < 2:  # noqa: PLR2004 - two cycles differ
            return np.full(self.cycles.shape[1], np.nan)
        sd: Array = self.cycles.std(axis=0, ddof=1)
        return sd


def find_gait_cycles(shank: SegmentSeries) -> GaitCycles:
    """Return the gait cycles of a leg.

    Parameters
    ----------
    shank
        Segment with x to the subject's right and z from the ankle to the knee (CONVENTIONS.md).
    """
    parts = list(_sagittal_rates(shank))
    if not parts:
        return GaitCycles(shank.name, np.empty((0, 2)), _data_fault(shank))

    fastest, candidates, reasons = 0.0, list[tuple[float, float]](), list[str]()
    for times, rates in parts:
        fastest = max(fastest, float(rates.max()))
        for cycle in _candidates(times, rates):
            reason = _objection(times, rates, cycle)
            if reason is None:
                candidates.append(cycle)
            else:
                reasons.append(reason)

    cycles = _regular_runs(candidates)
    found = np.array(cycles).reshape(-1, 2)
    if len(found):
        return GaitCycles(shank.name, found, None)
    if fastest < SWING_RATE:
        reason = (
            f"the {shank.name} rotates forward with at most {np.degrees(fastest):.0f}°/s; walking"
            f" needs more than {np.degrees(SWING_RATE):.0f}°/s"
        )
    elif reasons and len(reasons) >= len(candidates):
        reason = max(set(reasons), key=reasons.count)
    else:
        reason = f"no {LEAST_CYCLES} successive cycles of similar duration"
    return GaitCycles(shank.name, found, reason)


def _data_fault(shank: SegmentSeries) -> str:
    """Return the reason why a series has no part with a known angular velocity."""
    rate_hz = sample_rate_hz(shank.t_s)
    if rate_hz < _LEAST_HZ:
        return (
            f"the {shank.name} has {rate_hz:.1f} orientations per second, at least"
            f" {_LEAST_HZ:.0f} are needed"
        )
    if not np.isfinite(shank.orientation).any():
        return f"the orientation of the {shank.name} is unknown"
    return f"the orientation of the {shank.name} is nowhere known for {SHORTEST_S} s without a gap"


def _sagittal_rates(shank: SegmentSeries) -> Iterator[tuple[Array, Array]]:
    """Yield times and filtered forward rotation rate of the shank, rad/s, for each gapless part."""
    if len(shank.t_s) < 2:  # noqa: PLR2004 - a rate needs two rows
        return
    rate_hz = min(sample_rate_hz(shank.t_s), _GRID_HZ)
    if rate_hz < _LEAST_HZ:
        return
    times = np.arange(shank.t_s[0], shank.t_s[-1], 1.0 / rate_hz)
    q = interpolate_orientations(shank.t_s, shank.orientation, times)
    turned = rotation.log(rotation.multiply(rotation.conjugate(q[:-1]), q[1:]))
    forward = turned[:, 0] * rate_hz
    between = 0.5 * (times[:-1] + times[1:])

    filter_sections = butter(2, CUTOFF_HZ, fs=rate_hz, output="sos")
    known = np.isfinite(forward)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False])).astype(np.int8)))
    for start, end in edges.reshape(-1, 2):
        if between[end - 1] - between[start] >= SHORTEST_S:
            yield between[start:end], sosfiltfilt(filter_sections, forward[start:end])


def _candidates(times: Array, rates: Array) -> Iterator[tuple[float, float]]:
    """Yield the intervals between successive initial contacts."""
    step = times[1] - times[0]
    swings, _ = find_peaks(rates, height=SWING_RATE, distance=max(1, round(0.4 / step)))
    contacts = []
    for swing in swings:
        backward = np.flatnonzero(rates[swing:] <= 0.0)
        if backward.size:
            after = swing + int(backward[0])
            share = rates[after - 1] / (rates[after - 1] - rates[after])
            contacts.append(float(times[after - 1] + share * step))
    unique = sorted(set(contacts))
    yield from pairwise(unique)


def _objection(times: Array, rates: Array, cycle: tuple[float, float]) -> str | None:
    """Return the reason why an interval is not a gait cycle; None if it is a gait cycle."""
    start, end = cycle
    if not SHORTEST_S <= end - start <= LONGEST_S:
        return (
            f"the movements repeat after less than {SHORTEST_S} s or more than {LONGEST_S} s, which"
            " is not walking"
        )
    inside = rates[(times >= start) & (times < end)]
    share = float((inside > 0.0).mean())
    if not SWING_SHARE[0] <= share <= SWING_SHARE[1]:
        return (
            f"the shank rotates forward during {100 * share:.0f} % of a movement; in walking, the"
            f" share is {100 * SWING_SHARE[0]:.0f} to {100 * SWING_SHARE[1]:.0f} %"
        )
    if np.ptp(np.cumsum(inside)) * (times[1] - times[0]) < LEAST_RANGE:
        return (
            f"the inclination of the shank changes by less than {np.degrees(LEAST_RANGE):.0f}° in a"
            " movement"
        )
    return None


def _regular_runs(candidates: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the cycles that belong to runs of successive cycles of similar duration."""
    runs: list[list[tuple[float, float]]] = []
    for start, end in candidates:
        before = runs[-1][-1] if runs else None
        if before is not None and before[1] == start:
            ratio = (end - start) / (before[1] - before[0])
            if abs(ratio - 1.0) <= SAME_PACE:
                runs[-1].append((start, end))
                continue
        runs.append([(start, end)])
    return [cycle for run in runs if len(run) >= LEAST_CYCLES for cycle in run]


def normalize_cycles(t_s: Array, values: Array, cycles_s: Array, points: int = 101) -> CycleCurves:
    """Interpolate a series at 0 to 100 % of each cycle; cycles with unknown values are omitted.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Instants of the series, s.
    values : ndarray, shape (n,)
        Values at these instants.
    cycles_s : ndarray, shape (k, 2)
        Start and end of each cycle, s.
    points : int
        Number of instants per cycle.
    """
    share = np.linspace(0.0, 1.0, points)
    at_s = cycles_s[:, :1] + share * (cycles_s[:, 1:] - cycles_s[:, :1])
    curves = interpolate_values(t_s, values, at_s.ravel()).reshape(at_s.shape)
    return CycleCurves(100.0 * share, curves[np.isfinite(curves).all(axis=1)])
