"""How a sensor sits on its segment, from standing still: the robust mean and its acceptance.

Law: pure; one sensor's orientations in, one mean and its quality out. Re-donning changes only this
mean: everything else that is calibrated lives in bone-aligned coordinates and stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._robust_weights import (
    MAX_PASSES,
    SETTLED,
    huber_weights,
    robust_scale,
)
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class RobustMean:
    """A mean rotation and how far the data lie from it."""

    q: NDArray[np.float64]
    """The mean, shape (4,), unit, w >= 0."""
    spread: float
    """Robust scale of the angles to the mean, rad."""
    count: int
    """Rotations that were finite."""
    inlier_share: float
    """Share of them within 1.5 scales, that is of full weight."""


@dataclass(frozen=True, slots=True)
class StaticLimits:
    """What a static pose must meet."""

    still_s: float = 3.0
    """Least time of still frames, s."""
    spread: float = np.deg2rad(1.5)
    """Largest robust spread of one sensor, rad. A still wearer is within 1 degree; a good filter
    that wanders by 1 degree adds its own."""
    disagreement: float = np.deg2rad(3.0)
    """Largest difference, rad, between how sensors of one segment changed since the last pose."""


def robust_mean(q: ArrayLike, weights: ArrayLike | None = None) -> RobustMean:
    r"""Return the mean rotation of a noisy set, outliers held down by Huber weights.

    Iterates the largest eigenvector of :math:`M = \sum w_i q_i q_i^T` (Markley et al. 2007) with
    :math:`w_i = w_{0,i} \min(1, 1.5 s / e_i)`, where e_i is the angle to the mean and s its robust
    scale. Signs of the quaternions do not matter.

    Parameters
    ----------
    q : array_like, shape (n, 4)
        Unit quaternions; rows with NaN are left out.
    weights : array_like, shape (n,), optional
        Prior weights w0, not negative; equal if None.

    Raises
    ------
    ValueError
        No row is finite.
    """
    q = np.asarray(q, dtype=np.float64)
    finite = np.isfinite(q).all(axis=1)
    prior = np.ones(len(q)) if weights is None else np.asarray(weights, dtype=np.float64)
    good, prior = q[finite], prior[finite]
    weight = np.ones(len(good))
    mean = rotation.average(good, prior)
    scale = 0.0
    for _ in range(MAX_PASSES):
        angles = rotation.angle_between(mean, good)
        scale = robust_scale(angles)
        before, weight = weight, huber_weights(angles, scale)
        mean = rotation.average(good, prior * weight)
        if float(np.max(np.abs(weight - before))) < SETTLED:
            break
    return RobustMean(mean, scale, len(good), float(np.mean(weight >= 1.0)))


def static_bias(
    q_world_sensor: ArrayLike, q_world_segment: ArrayLike = rotation.IDENTITY
) -> RobustMean:
    r"""Return the mount ``q_sensor_segment`` of a sensor from still frames.

    .. math:: b_i = q_{s,i}^* \otimes q_{O,i}

    and their robust mean; in motion ``q_world_segment = multiply(q_world_sensor, mount)``.
    Source: the patent's static step, with its component-wise mean replaced.

    Parameters
    ----------
    q_world_sensor : array_like, shape (n, 4)
        Still frames only.
    q_world_segment : array_like, shape (n, 4) or (4,)
        Segment orientation in the same world: the identity in the static world, or the optical one.
    """
    return robust_mean(rotation.multiply(rotation.conjugate(q_world_sensor), q_world_segment))


def static_problems(
    means: Mapping[str, RobustMean], still_s: float, limits: StaticLimits | None = None
) -> tuple[str, ...]:
    """Return why a static pose cannot be used, one sentence each; empty if it can.

    Parameters
    ----------
    means : mapping
        Per sensor id, what ``static_bias`` found.
    still_s : float
        Time for which all alive sensors were still, s.
    """
    limits = limits or StaticLimits()
    found = []
    if still_s < limits.still_s:
        found.append(
            f"still for {still_s:.1f} s, {limits.still_s:.1f} s are needed: stand still for longer"
        )
    found += [
        f"{sensor}: orientations spread by {np.rad2deg(mean.spread):.1f} deg while still, at most "
        f"{np.rad2deg(limits.spread):.1f} deg are accepted: fasten the sensor, repeat the pose"
        for sensor, mean in means.items()
        if mean.spread > limits.spread
    ]
    return tuple(found)


def redonning_problems(
    before: Mapping[str, ArrayLike],
    after: Mapping[str, ArrayLike],
    segments: Mapping[str, Sequence[str]],
    limits: StaticLimits | None = None,
) -> tuple[str, ...]:
    """Return which sensors of one segment moved differently between two static poses.

    The change of a mount seen from the segment is ``before* after``; sensors that were not taken
    off show the same change, that of the pose.

    Parameters
    ----------
    before, after : mapping
        ``q_sensor_segment`` per sensor id, shape (4,).
    segments : mapping
        Sensor ids per segment.
    """
    limits = limits or StaticLimits()
    found = []
    for segment, sensors in segments.items():
        known = [s for s in sensors if s in before and s in after]
        # the mount maps segment to sensor: what the segment did lies on its right-hand side
        changes = [rotation.multiply(rotation.conjugate(before[s]), after[s]) for s in known]
        for sensor, change in zip(known[1:], changes[1:], strict=True):
            apart = float(rotation.angle_between(changes[0], change))
            if apart > limits.disagreement:
                found.append(
                    f"{segment}: {known[0]} and {sensor} differ by {np.rad2deg(apart):.1f} deg in "
                    "how they changed since the last static pose: one was moved, or its heading "
                    "drifted; if both were taken off and put on again, this is expected"
                )
    return tuple(found)
