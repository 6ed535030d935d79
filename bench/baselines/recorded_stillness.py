"""Detection of rest in recordings, from angular rates or orientations in centered windows.

Only variances and relative rotations are used, so a constant gyroscope bias or an arbitrary heading
has no influence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RecordedStillnessLimits:
    """Thresholds of rest.

    If the values of a sensor at rest on a table are above a third of `gyr` or `acc`, use three
    times these values.
    """

    window_s: float = 1.0
    """Duration of the window that must be at rest, s."""
    shortest_s: float = 1.5
    """Minimum duration of rest, s. Shorter periods are ignored."""
    gyr: float = np.deg2rad(1.0)
    """Limit for the root of the summed variances of the three rates, rad/s."""
    acc: float = 0.15
    """Limit for the root of the summed variances of the three specific forces, m/s^2."""
    turn: float = np.deg2rad(1.0)
    """Largest rotation from the first step of a window to any later step, rad."""
    step_s: float = 0.05
    """Averaging interval of the orientations, s."""


def still_from_rates(
    gyr: ArrayLike, acc: ArrayLike, rate_hz: float, limits: RecordedStillnessLimits | None = None
) -> Mask:
    """Return whether each sample is at rest, from raw data in centered windows.

    A sample is a candidate if the roots of the summed variances of rate and specific force over its
    window are below their limits. Runs of candidates shorter than ``shortest_s`` are dropped.

    Parameters
    ----------
    gyr : array_like, shape (n, 3)
        Angular rate, rad/s.
    acc : array_like, shape (n, 3)
        Specific force, m/s^2.
    rate_hz : float
        Sampling rate, Hz.
    limits : RecordedStillnessLimits, optional
        Thresholds; the default thresholds if omitted.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    limits = limits or RecordedStillnessLimits()
    size = max(2, round(limits.window_s * rate_hz))
    candidate = (_moving_spread(gyr, size) < limits.gyr) & (_moving_spread(acc, size) < limits.acc)
    return _long_runs(candidate, round(limits.shortest_s * rate_hz))


def still_from_orientation(
    q_world_sensor: ArrayLike, rate_hz: float, limits: RecordedStillnessLimits | None = None
) -> Mask:
    """Return whether each sample is at rest, from orientations only.

    A window is at rest if the rotation from its first step (0.05 s) to every later step is below
    the limit. The center of the window is then a candidate. Runs of candidates shorter than
    ``shortest_s`` are dropped. A step is the mean of its samples, so white noise of a third of a
    degree does not appear as movement.

    Parameters
    ----------
    q_world_sensor : array_like, shape (n, 4)
        Orientations at a constant rate. A window with NaN is not at rest.
    rate_hz : float
        Sampling rate, Hz.
    limits : RecordedStillnessLimits, optional
        Thresholds; the default thresholds if omitted.

    Returns
    -------
    ndarray of bool, shape (n,)
        The samples of the first (last) half window have the value of the first (last) complete
        window.
    """
    limits = limits or RecordedStillnessLimits()
    q = rotation.continuous(q_world_sensor)
    count = len(q)

    size, step = round(limits.window_s * rate_hz), max(1, round(limits.step_s * rate_hz))
    q = _step_means(q, step)
    starts = len(q) - size
    if starts <= 0:
        return np.zeros(count, dtype=bool)

    # Compute the rotation from the first step of every window to each of its later steps.
    calm = np.ones(starts, dtype=bool)
    for later in range(step, size + 1, step):
        turned = rotation.angle_between(q[:starts], q[later : later + starts])
        calm &= np.nan_to_num(turned, nan=np.inf) < limits.turn

    before = (size + step) // 2
    candidate = np.pad(calm, (before, count - starts - before), mode="edge")
    return _long_runs(candidate, round(limits.shortest_s * rate_hz))


def _step_means(q: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Return the normalized means of `step` successive rows, shape (n - `step` + 1, 4)."""
    count = max(0, len(q) - step + 1)
    total = np.zeros((count, 4))
    for offset in range(step):
        total += q[offset : offset + count]
    return rotation.normalize(total)


def _moving_spread(samples: ArrayLike, size: int) -> NDArray[np.float64]:
    values = np.array(samples, dtype=np.float64)
    values -= values.mean(axis=0)  # a large offset would reduce the precision
    mean, square = _moving_mean(values, size), _moving_mean(values**2, size)
    spread: NDArray[np.float64] = np.sqrt(np.maximum(square - mean**2, 0.0).sum(axis=1))
    return spread


def _moving_mean(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the means of `size` rows centered at each row.

    Rows beyond the ends are replaced by the end row. The means are computed from running sums.
    """
    before = size // 2
    padded = np.pad(values, ((before + 1, size - 1 - before), (0, 0)), mode="edge")
    padded[0] = 0.0  # the sum of no rows
    total = np.cumsum(padded, axis=0)
    means: NDArray[np.float64] = (total[size:] - total[:-size]) / size
    return means


def _long_runs(mask: Mask, shortest: int) -> Mask:
    """Return only runs of at least `shortest` samples."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    kept = np.zeros_like(mask)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        kept[begin:end] = end - begin >= shortest
    return kept
