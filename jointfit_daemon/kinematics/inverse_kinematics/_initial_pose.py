"""Initial pose of a search, with each segment aligned to its own markers.

Segments are aligned from the root outwards. The rotation of a segment is the best map of its
markers to the measured markers, and of its joint center to the joint center in the parent (Wahba's
problem). A hinge uses only the rotation about the hinge axis. A coupled joint uses the nearest pose
on its curve.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import exp_matrix, place_coupled, rest_state
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import marker_slots

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState

_SQUARINGS = 10
"""Number of matrix squarings in the power iteration of the eigenvector."""
_THIN_M2 = 1e-4
"""Second largest moment of a marker cloud, m², below which the rotation is undetermined. It is (1
cm)².
"""
_PULL_TO_REST = 1e-9
"""Relative weight of the rest rotation, which has an effect only along undetermined directions."""


def start_from_markers(
    model: ChainModel, measured: Array, weights: Array
) -> tuple[ChainState, NDArray[np.bool_]]:
    """Return the initial state, and a mask of the instants at which a segment is undetermined.

    Parameters
    ----------
    model
        The chain.
    measured
        Marker positions, m, shape (T, S, 3, K), finite.
    weights
        Marker weights, shape (T, S, K), zero where markers are missing.
    """
    slots, count = marker_slots(model), len(measured)
    rest = rest_state(model).rotations[0]
    curves = {segment: curve for segment, _, curve in slots.layout.coupled}
    amounts: list[Array] = []
    world_R = np.empty((count, len(model.segments), 3, 3))
    world_t = np.empty((count, len(model.segments), 3))
    A = np.empty_like(world_R)
    guessed = np.zeros(count, dtype=np.bool_)
    for i, (segment, parent) in enumerate(zip(model.segments, model.parents, strict=True)):
        joint = segment.joint
        curve = curves.get(i)
        own, corner = np.asarray(joint.center), np.asarray(joint.center_in_parent)
        if curve is not None:
            corner = corner + curve.at(np.array([curve.home]))[1][0, 1:4]
        if parent < 0:
            above_R, center = np.eye(3)[None], corner[None]
        else:
            above_R = world_R[:, parent]
            center = world_t[:, parent] + above_R @ corner

        cloud = (
            np.broadcast_to(slots.points[i, :3], measured[:, i].shape),
            measured[:, i],
            weights[:, i],
        )
        if joint.kind != "free":
            cloud = _with_center(*cloud, own, center)

        laid, middle, spans = _fit_cloud(*cloud, above_R @ rest[i])
        has_markers = bool((slots.places // slots.shape[1] == i).any())
        guessed |= (spans < _THIN_M2) & has_markers
        turned = np.swapaxes(above_R, -1, -2) @ laid
        A[:, i] = _about_axis(rest[i], turned, joint.axis) if joint.kind == "hinge" else turned
        if curve is not None:
            amounts.append(curve.nearest(turned))
            A[:, i], coupling = curve.at(amounts[-1])
            shifted = np.asarray(joint.center_in_parent) + coupling[:, 1:4] - corner
            center = center + (above_R @ shifted[..., None])[..., 0]

        world_R[:, i] = above_R @ A[:, i]
        if joint.kind == "free":
            world_t[:, i] = middle
        else:
            world_t[:, i] = center - world_R[:, i] @ own
    found = np.stack(amounts, axis=1) if amounts else None
    return place_coupled(slots.layout, A, world_t[:, slots.layout.free], found), guessed


def _with_center(
    points: Array, measured: Array, weights: Array, own: Array, center: Array
) -> tuple[Array, Array, Array]:
    """Return a marker cloud with the joint center in the parent as an additional point."""
    count = len(points)
    return (
        np.concatenate((points, np.broadcast_to(own[:, None], (count, 3, 1))), axis=-1),
        np.concatenate((measured, np.broadcast_to(center[..., None], (count, 3, 1))), axis=-1),
        np.concatenate((weights, np.ones((count, 1))), axis=-1),
    )


def _fit_cloud(
    points: Array, measured: Array, weights: Array, rest: Array
) -> tuple[Array, Array, Array]:
    """Return rotation (T, 3, 3), origin (T, 3) and second largest moment (T,) of a marker cloud.

    The moment, m², is an upper bound.
    """
    total = np.maximum(weights.sum(axis=-1), 1e-12)[:, None]
    middle_p = (points @ weights[..., None])[..., 0] / total
    middle_y = (measured @ weights[..., None])[..., 0] / total
    p, y = points - middle_p[..., None], measured - middle_y[..., None]
    moments = (p * weights[:, None]) @ np.swapaxes(p, -1, -2)

    size = np.trace(moments, axis1=-2, axis2=-1)
    B = (y * weights[:, None]) @ np.swapaxes(p, -1, -2)
    R = _nearest_rotation(B + (_PULL_TO_REST * size + 1e-12)[:, None, None] * rest)
    minors = 0.5 * (size**2 - np.einsum("tij,tij->t", moments, moments))
    second = minors / np.maximum(size, 1e-12)  # upper bound of the second eigenvalue
    return R, middle_y - (R @ middle_p[..., None])[..., 0], second


def _nearest_rotation(B: Array) -> Array:
    """Return the rotations, shape (T, 3, 3), that maximize :math:`tr(R^T B)`.

    The quaternion is the dominant eigenvector of Davenport's matrix. It is computed by ten
    squarings of the matrix, without a decomposition. Source: Horn 1987, doi 10.1364/JOSAA.4.000629.
    """
    K = np.empty((len(B), 4, 4))
    trace = np.trace(B, axis1=-2, axis2=-1)
    K[:, 1:, 1:] = B + np.swapaxes(B, -1, -2)
    K[:, 0, 1:] = K[:, 1:, 0] = np.stack(
        (B[:, 2, 1] - B[:, 1, 2], B[:, 0, 2] - B[:, 2, 0], B[:, 1, 0] - B[:, 0, 1]), axis=-1
    )
    K[:, 0, 0] = trace
    shift = np.sqrt(np.einsum("tij,tij->t", B, B))  # makes all eigenvalues positive
    diagonal = np.arange(4)
    K[:, diagonal, diagonal] += 1.8 * shift[:, None]
    K[:, diagonal[1:], diagonal[1:]] -= trace[:, None]
    for _ in range(_SQUARINGS):
        K /= np.trace(K, axis1=-2, axis2=-1)[:, None, None]
        K = K @ K
    best = np.argmax(np.diagonal(K, axis1=-2, axis2=-1), axis=-1)
    return rotation.to_matrix(rotation.normalize(K[np.arange(len(K)), :, best]))


def _about_axis(rest: Array, turned: Array, axis: tuple[float, float, float]) -> Array:
    r"""Return the rotation of a hinge nearest to `turned`, shape (T, 3, 3).

    .. math:: \tan\theta = \frac{\sum_{ij} R_{ij} [a]_{\times,ij}}{tr R - a^T R a}, \qquad
              R = R_{rest}^T R_{turned}

    where θ is the angle of the hinge and a its axis.
    """
    R, a = rest.T @ turned, np.asarray(axis)
    along = np.einsum("tij,ij->t", R, rotation.skew(a))
    across = np.trace(R, axis1=-2, axis2=-1) - np.einsum("i,tij,j->t", a, R, a)
    return np.asarray(rest @ exp_matrix(np.arctan2(along, across)[:, None] * a))
