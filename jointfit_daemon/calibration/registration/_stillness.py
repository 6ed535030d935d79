"""Detection of rest from angular rates or orientations, recorded or live.

Time is the time of the samples. Only variances and relative rotations are used, so a constant gyro
bias or an arbitrary heading has no influence.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import angle_between_one, normalize_one

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.model import Quaternion

    Mask = NDArray[np.bool_]

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class StillnessLimits:
    """Thresholds of rest. For a noisier sensor use three times its values on a table."""

    window_s: float = 1.0
    """Length of the window that must be at rest, s."""
    shortest_s: float = 1.5
    """Shorter periods of rest are ignored, s (recordings only; the live session requires longer
    ones)."""
    gyr: float = np.deg2rad(1.0)
    """Root of the summed variances of the three rates, rad/s."""
    acc: float = 0.15
    """Root of the summed variances of the three specific forces, m/s^2."""
    turn: float = np.deg2rad(1.0)
    """Largest rotation from the first step of a window to any later step, rad."""
    step_s: float = 0.05
    """Averaging interval of the orientations, s."""


def still_from_rates(
    gyr: ArrayLike, acc: ArrayLike, rate_hz: float, limits: StillnessLimits | None = None
) -> Mask:
    """Return the samples at rest, from raw data over centered windows.

    A sample is a candidate if the root of the summed variances over its window is below both
    limits. Runs of candidates shorter than ``shortest_s`` are dropped.

    Parameters
    ----------
    gyr : array_like, shape (n, 3)
        Angular rate, rad/s.
    acc : array_like, shape (n, 3)
        Specific force, m/s^2.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    limits = limits or StillnessLimits()
    size = max(2, round(limits.window_s * rate_hz))
    candidate = (_moving_spread(gyr, size) < limits.gyr) & (_moving_spread(acc, size) < limits.acc)
    return _long_runs(candidate, round(limits.shortest_s * rate_hz))


def still_from_orientation(
    q_world_sensor: ArrayLike, rate_hz: float, limits: StillnessLimits | None = None
) -> Mask:
    """Return the samples at rest, from orientations only.

    A window is at rest if the rotation from its first 0.05 s step to every later one is below the
    limit. The center of the window is then a candidate, and runs shorter than ``shortest_s`` are
    dropped. A step is the mean of its samples, so that white noise of a third of a degree is no
    movement.

    Parameters
    ----------
    q_world_sensor : array_like, shape (n, 4)
        Evenly sampled; a window with NaN is not at rest.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    ndarray of bool, shape (n,)
        Half a window at either end has the value of the first or last complete window.
    """
    limits = limits or StillnessLimits()
    q = rotation.continuous(q_world_sensor)
    count = len(q)

    size, step = round(limits.window_s * rate_hz), max(1, round(limits.step_s * rate_hz))
    q = _step_means(q, step)
    starts = len(q) - size
    if starts <= 0:
        return np.zeros(count, dtype=bool)

    # Rotation from the first step of every window to each of its later steps.
    calm = np.ones(starts, dtype=bool)
    for later in range(step, size + 1, step):
        turned = rotation.angle_between(q[:starts], q[later : later + starts])
        calm &= np.nan_to_num(turned, nan=np.inf) < limits.turn

    before = (size + step) // 2
    candidate = np.pad(calm, (before, count - starts - before), mode="edge")
    return _long_runs(candidate, round(limits.shortest_s * rate_hz))


class StillnessMonitor:
    """Detects from live samples whether one sensor was at rest for a complete window.

    This is the causal form of `still_from_orientation`. The window ends with the last complete
    step, so a movement is detected at most one step late. A pause in the data or time running
    backwards starts a new window.
    """

    def __init__(self, limits: StillnessLimits | None = None) -> None:
        limits = limits or StillnessLimits()
        self._turn = limits.turn
        self._window_ns = round(limits.window_s * _NS)
        self._step_ns = round(limits.step_s * _NS)
        self._longest_pause_ns = self._window_ns // 4
        self._steps: deque[tuple[int, Quaternion]] = deque()  # at most window / step + 2
        self._began_ns = self._last_ns = 0
        self._sum: Quaternion | None = None
        self._calm = False

    def feed(self, t_ns: int, q: Quaternion) -> bool:
        """Process one orientation at `t_ns`; return True while the last window was at rest."""
        pause = t_ns - self._last_ns
        self._last_ns = t_ns
        if self._sum is None or not 0 <= pause <= self._longest_pause_ns:
            self._steps.clear()
            self._begin(t_ns, q)
            self._calm = False
        elif t_ns - self._began_ns >= self._step_ns:
            self._steps.append((t_ns, normalize_one(self._sum)))
            self._begin(t_ns, q)
            self._calm = self._judge(t_ns)
        else:
            w, x, y, z = self._sum
            sign = -1.0 if w * q[0] + x * q[1] + y * q[2] + z * q[3] < 0.0 else 1.0
            self._sum = (w + sign * q[0], x + sign * q[1], y + sign * q[2], z + sign * q[3])
        return self._calm

    def _begin(self, t_ns: int, q: Quaternion) -> None:
        self._began_ns, self._sum = t_ns, q

    def _judge(self, t_ns: int) -> bool:
        steps = self._steps
        while len(steps) > 1 and t_ns - steps[1][0] >= self._window_ns:
            steps.popleft()
        began, start = steps[0]
        # With irregular time stamps the steps are up to one step shorter than the window.
        if t_ns - began < self._window_ns - self._step_ns:
            return False
        return all(angle_between_one(start, q) < self._turn for _, q in steps)


def _step_means(q: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Return the normalized mean of every `step` successive rows; `step` - 1 rows fewer."""
    count = max(0, len(q) - step + 1)
    total = np.zeros((count, 4))
    for offset in range(step):
        total += q[offset : offset + count]
    return rotation.normalize(total)


def _moving_spread(samples: ArrayLike, size: int) -> NDArray[np.float64]:
    values = np.array(samples, dtype=np.float64)
    values -= values.mean(axis=0)  # variances about a large offset would lose digits
    mean, square = _moving_mean(values, size), _moving_mean(values**2, size)
    spread: NDArray[np.float64] = np.sqrt(np.maximum(square - mean**2, 0.0).sum(axis=1))
    return spread


def _moving_mean(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the means over windows of `size` rows about each row; end rows are repeated beyond.

    Running sums instead of a scipy filter: importing scipy would double the start time of the
    daemon.
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
