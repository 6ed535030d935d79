"""Time axes of series, their rate and uniformity, and interpolation at other instants.

Gaps are not bridged. An interpolated row is unknown if its two neighbors are more than
`MAX_GAP_SAMPLES` periods apart, or if one of them is unknown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

MAX_GAP_SAMPLES = 1.5
"""Longest interval that is interpolated, in median sample periods. With this limit no missing
sample is bridged."""
UNIFORM_SHARE = 0.01
"""Largest deviation of an instant from a uniform time axis, in sample periods."""
_EXACT_SHARE = 1e-6
"""Largest distance between an instant and a row, in sample periods, at which the value of the row
is returned without interpolation. A series with a single row is assigned a period of 1 s.
"""


def sample_rate_hz(t_s: Array) -> float:
    """Return the rate, Hz, of instants, s, shape (n,), which is the inverse of the median interval.

    The result is NaN for fewer than two instants.
    """
    return 1.0 / float(np.median(np.diff(t_s))) if len(t_s) > 1 else float("nan")


def is_uniform(t_s: Array) -> bool:
    """Return whether all instants, s, shape (n,), lie on a uniform time axis, without gaps."""
    if len(t_s) < 2:  # noqa: PLR2004 - an interval has two ends
        return True
    period = (t_s[-1] - t_s[0]) / (len(t_s) - 1)
    expected = t_s[0] + period * np.arange(len(t_s))
    return bool((np.abs(t_s - expected) <= UNIFORM_SHARE * period).all())


def uniform_times(axes: Sequence[Array]) -> Array:
    """Return a uniform time axis for several series at their highest rate, s, shape (n,).

    If all series have the same uniform axis, this axis is returned. Otherwise the axis contains the
    first row of the series with the highest rate, has the period of this series, and extends over
    the range of all series.
    """
    filled = [t_s for t_s in axes if len(t_s)]
    if not filled:
        return np.empty(0)
    first = filled[0]
    if is_uniform(first) and all(np.array_equal(t_s, first) for t_s in filled):
        return first

    # Among series of equal rate the first is used, because their periods differ only by rounding.
    shortest = min(map(_period, filled))
    fastest = next(t_s for t_s in filled if _period(t_s) <= shortest * (1.0 + UNIFORM_SHARE))
    period = _period(fastest)
    if not np.isfinite(period):
        period = 1.0
    before = np.floor((min(t_s[0] for t_s in filled) - fastest[0]) / period + UNIFORM_SHARE)
    after = np.ceil((max(t_s[-1] for t_s in filled) - fastest[0]) / period - UNIFORM_SHARE)
    times: Array = fastest[0] + period * np.arange(before, after + 1.0)
    return times


def _period(t_s: Array) -> float:
    """Return the mean sample period, s, without gaps; infinity for fewer than two rows."""
    if len(t_s) < 2:  # noqa: PLR2004 - an interval has two ends
        return float("inf")
    steps = np.diff(t_s)
    periods = np.round(steps / np.median(steps)).sum()
    return float((t_s[-1] - t_s[0]) / max(periods, 1.0))


def rows_on_axis(t_s: Array, axis_s: Array) -> NDArray[np.intp] | None:
    """Return the row of a uniform axis at which each instant lies.

    The result is None if an instant lies at no row, or if two instants lie at the same row.

    Parameters
    ----------
    t_s
        Instants of a series, s, shape (n,).
    axis_s
        Uniform axis, s, shape (m,).
    """
    if len(axis_s) < 2:  # noqa: PLR2004 - an interval has two ends
        return np.zeros(len(t_s), np.intp) if len(t_s) <= len(axis_s) else None
    period = (axis_s[-1] - axis_s[0]) / (len(axis_s) - 1)
    rows = np.round((t_s - axis_s[0]) / period).astype(np.intp)
    inside = (rows >= 0) & (rows < len(axis_s))
    if not inside.all() or len(np.unique(rows)) < len(rows):
        return None
    near = np.abs(t_s - axis_s[rows]) <= 2.0 * UNIFORM_SHARE * period
    return rows if near.all() else None


def interpolate_values(t_s: Array, values: Array, at_s: Array) -> Array:
    """Return `values`, shape (n, ...), interpolated linearly at `at_s`, as shape (m, ...).

    The result is NaN at instants outside the series or in a gap.
    """
    i, j, share = _neighbours(t_s, at_s)
    if not len(t_s):
        return np.full((len(at_s), *values.shape[1:]), np.nan)
    share = share.reshape(-1, *([1] * (values.ndim - 1)))
    # At the instant of a row the next row is not used, because 0 times NaN is NaN.
    between: Array = np.where(
        share == 0.0, values[i], (1.0 - share) * values[i] + share * values[j]
    )
    return between


def interpolate_orientations(t_s: Array, q: Array, at_s: Array) -> Array:
    """Return orientations `q`, shape (n, 4), interpolated at `at_s`, as shape (m, 4).

    The interpolation is spherical linear, q_i exp(a log(q_i* q_k)), along the shortest rotation
    from row i to the next row k. a is the position between these rows, from 0 to 1. The result is
    NaN at instants outside the series or in a gap.
    """
    i, j, share = _neighbours(t_s, at_s)
    if not len(t_s):
        return np.full((len(at_s), 4), np.nan)
    turned = rotation.interpolate(q[i], q[j], share)
    between: Array = np.where(share[:, None] == 0.0, q[i], turned)
    return between


def _neighbours(t_s: Array, at_s: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return the rows before and after each instant, and its position between them, 0 to 1.

    The position is NaN outside the series and in gaps.
    """
    if not len(t_s):
        none = np.zeros(len(at_s), dtype=np.intp)
        return none, none, np.full(len(at_s), np.nan)
    last = len(t_s) - 1
    period = float(np.median(np.diff(t_s))) if last else np.inf
    near = _EXACT_SHARE * (period if last else 1.0)

    i = np.clip(np.searchsorted(t_s, at_s + near, side="right") - 1, 0, last)
    j = np.minimum(i + 1, last)
    width = np.where(j > i, t_s[j] - t_s[i], np.inf)
    share = (at_s - t_s[i]) / width
    share[np.abs(at_s - t_s[i]) <= near] = 0.0
    share[(share < 0.0) | (share > 1.0) | ((share > 0.0) & (width > MAX_GAP_SAMPLES * period))] = (
        np.nan
    )
    beyond = (i == last) & (at_s > t_s[last] + near)
    share[beyond] = np.nan
    return i, j, share
