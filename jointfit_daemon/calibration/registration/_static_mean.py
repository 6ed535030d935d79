"""Robust mean orientation in the static pose, and the check whether it is accepted.

Re-donning a sensor changes only this mean, because all other calibrated quantities are in
bone-aligned coordinates.
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


MAX_DISAGREEMENT = np.deg2rad(3.0)
"""Largest difference between the changes of two mounts on one segment since the last pose, rad."""


@dataclass(frozen=True, slots=True)
class RobustMean:
    """Mean rotation with its scatter."""

    q: NDArray[np.float64]
    """Mean as a unit quaternion with w >= 0, shape (4,)."""
    spread: float
    """Robust scale of the angles to the mean, rad."""


@dataclass(frozen=True, slots=True)
class StaticLimits:
    """Acceptance limits of a static pose."""

    still_s: float = 3.0
    """Shortest duration without movement, s."""
    spread: float = np.deg2rad(1.5)
    """Largest robust scatter of one sensor, rad. A standing subject moves by less than 1 degree; a
    good orientation filter drifts by up to 1 degree."""


def robust_mean(q: ArrayLike, weights: ArrayLike | None = None) -> RobustMean:
    r"""Return the mean rotation of noisy orientations, with Huber weights against outliers.

    The mean is computed iteratively as the largest eigenvector of :math:`M = \sum w_i q_i q_i^T`
    (Markley et al. 2007) with :math:`w_i = w_{0,i} \min(1, 1.5 s / e_i)`, where e_i is the angle to
    the mean and s its robust scale. The signs of the quaternions have no effect.

    Parameters
    ----------
    q : array_like, shape (n, 4)
        Unit quaternions; rows with NaN are ignored.
    weights : array_like, shape (n,), optional
        Non-negative prior weights w0; equal by default.

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
    return RobustMean(mean, scale)


def component_mean(q: ArrayLike) -> RobustMean:
    r"""Return the normalized mean of the components of orientations, as in the patent.

    .. math:: \bar q = \sum s_i q_i \,/\, \lVert \sum s_i q_i \rVert, \qquad s_i = \pm 1

    The sign :math:`s_i` is selected so that the scalar product of :math:`s_i q_i` and the first
    quaternion is not negative. The mean bias of step S2, :math:`\overline{q_i^* \otimes q_O}`,
    equals :math:`\bar q^* \otimes q_O` except for its norm, because the product is linear. The norm
    has no effect on the regression that follows.

    Parameters
    ----------
    q : array_like, shape (n, 4)
        Unit quaternions; rows with NaN are ignored.

    Raises
    ------
    ValueError
        No row is finite.
    """
    q = np.asarray(q, dtype=np.float64)
    good = q[np.isfinite(q).all(axis=1)]
    if len(good) == 0:
        raise ValueError("no finite orientation to average")
    mean = rotation.normalize(rotation.align_hemisphere(good, good[0]).mean(axis=0))
    mean = rotation.align_hemisphere(mean, rotation.IDENTITY)
    return RobustMean(mean, robust_scale(rotation.angle_between(mean, good)))


def static_mount(
    q_world_sensor: ArrayLike, q_world_segment: ArrayLike = rotation.IDENTITY
) -> RobustMean:
    r"""Return the sensor-to-segment alignment ``q_sensor_segment`` from the static pose.

    .. math:: b_i = q_{s,i}^* \otimes q_{O,i}

    The result is the robust mean of :math:`b_i`. In motion ``q_world_segment =
    multiply(q_world_sensor, mount)``. The source is the static step of the patent; a rotation mean
    replaces the component-wise mean of the patent.

    Parameters
    ----------
    q_world_sensor : array_like, shape (n, 4)
        Frames of the static pose only.
    q_world_segment : array_like, shape (n, 4) or (4,)
        Segment orientation in the same world. Without cameras it is the
        identity, otherwise the orientation from the optical system.
    """
    return robust_mean(rotation.multiply(rotation.conjugate(q_world_sensor), q_world_segment))


def static_problems(
    means: Mapping[str, RobustMean], still_s: float, limits: StaticLimits | None = None
) -> tuple[str, ...]:
    """Return the reasons to reject a static pose, one sentence each; empty if it is accepted.

    Parameters
    ----------
    means : mapping
        Robust mean of each sensor.
    still_s : float
        Duration for which all available sensors were at rest, s.
    limits : StaticLimits, optional
        Acceptance limits; by default the default values of `StaticLimits`.
    """
    limits = limits or StaticLimits()
    found = []
    if still_s < limits.still_s:
        found.append(
            f"static pose of {still_s:.1f} s, {limits.still_s:.1f} s are needed: "
            "stand still for longer"
        )

    found += [
        f"{sensor}: orientation scatters by {np.rad2deg(mean.spread):.1f} deg in the static "
        f"pose, at most {np.rad2deg(limits.spread):.1f} deg are accepted: "
        "fasten the sensor and repeat the pose"
        for sensor, mean in means.items()
        if mean.spread > limits.spread
    ]
    return tuple(found)


def redonning_notes(
    before: Mapping[str, ArrayLike],
    after: Mapping[str, ArrayLike],
    segments: Mapping[str, Sequence[str]],
) -> tuple[str, ...]:
    """Return notes on the sensors of a segment that moved differently between two static poses.

    The change of a mount in segment axes is ``before* after``. For sensors that were not taken off,
    this change equals the change of the pose.

    Parameters
    ----------
    before, after : mapping
        ``q_sensor_segment`` of each sensor, shape (4,).
    segments : mapping
        Sensors of each segment.
    """
    found = []
    for segment, sensors in segments.items():
        known = [s for s in sensors if s in before and s in after]
        # The mount is q_sensor_segment, so a change of the segment multiplies it on the right.
        changes = [rotation.multiply(rotation.conjugate(before[s]), after[s]) for s in known]
        for sensor, change in zip(known[1:], changes[1:], strict=True):
            apart = float(rotation.angle_between(changes[0], change))
            if apart > MAX_DISAGREEMENT:
                found.append(
                    f"{segment}: {known[0]} and {sensor} differ by {np.rad2deg(apart):.1f} deg in "
                    "their change since the last static pose: one sensor was moved, or its heading "
                    "drifted; after re-donning both sensors this is expected"
                )
    return tuple(found)
