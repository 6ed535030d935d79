"""Axis of a hinge from the poses of two bodies (SARA).

The movement does not determine the position of the center along the axis. A movement about two axes
is refused.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.center_of_rotation.spatial._score import two_sided_estimate

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._movement import BodyPoses
    from jointfit_daemon.center_of_rotation._result import CenterEstimate


def fit_axis(
    parent: BodyPoses,
    child: BodyPoses,
    *,
    near: Array | None = None,
    toward: Array | None = None,
    robust: bool = True,
    markers: tuple[Array, Array] | None = None,
) -> CenterEstimate:
    """Estimate the axis of a hinge and the point of the axis nearest to `near`.

    The right singular vector of [R₁, -R₂] with the smallest singular value consists of the axis in
    the coordinates of parent and child. R₁ and R₂ are the rotations of parent and child in all
    frames. Source: Ehrig et al. 2007.

    Parameters
    ----------
    parent, child : BodyPoses
        Poses of both bodies in the same world coordinates.
    near : ndarray, shape (3,), optional
        Point in the parent's coordinates, m. The center is the point of the axis that is nearest to
        this point. By default, it is the parent's origin.
    toward : ndarray, shape (3,), optional
        Direction along which the axis has a positive component, such as the subject's right.
    robust : bool
        Whether to apply Huber weights to the gap between the points of both bodies.
    markers : tuple of ndarray, optional
        Markers of parent and child, as in `two_sided_estimate`.

    Returns
    -------
    CenterEstimate
        Estimate with `axis` in the parent's coordinates. The estimate is refused if the movement
        was about more than one axis.
    """
    estimate = two_sided_estimate(
        "sara", parent, child, near, hinge=True, robust=robust, markers=markers
    )
    axis = estimate.axis
    if axis is None or toward is None or float(axis @ toward) >= 0.0:
        return estimate
    return replace(estimate, axis=-axis, unseen=-estimate.unseen)
