r"""Joint positions from segment orientations and lengths, with their covariance.

.. math:: P_{i+1} = P_i + R(q_i)\, \ell_i, \qquad \ell_i = (0, 0, -L_i)

Law: segment frames have z proximal, so a hanging segment points along its own -z. (The patent
prints +z, which puts the knee above the hip; the axis is a parameter with that one as remedy.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import rotate_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector

DISTAL: Vector = (0.0, 0.0, -1.0)
"""Direction from a segment's proximal to its distal joint, in segment axes."""


class ChainPositions(NamedTuple):
    """Where the joints of a chain are."""

    positions: Array
    """World, m, shape (..., n + 1, 3): O1 first."""
    covariances: Array
    """m^2, shape (..., n + 1, 3, 3), world axes."""


def joint_positions(
    origin: ArrayLike, q_world_segment: ArrayLike, lengths: ArrayLike, axis: ArrayLike = DISTAL
) -> Array:
    """Return the joints O1 … On+1 of a chain of n segments, m, shape (..., n + 1, 3).

    Parameters
    ----------
    origin : array_like, shape (..., 3)
        O1 in the world, m.
    q_world_segment : array_like, shape (..., n, 4)
        Proximal segment first.
    lengths : array_like, shape (n,)
        m.
    axis : array_like, shape (3,) or (n, 3)
        Unit vector from proximal to distal joint, segment axes.
    """
    steps = rotation.rotate(q_world_segment, _offsets(lengths, axis))
    origin = np.asarray(origin, dtype=np.float64)
    start = np.broadcast_to(origin[..., None, :], (*steps.shape[:-2], 1, 3))
    return np.cumsum(np.concatenate((start, steps), axis=-2), axis=-2)


def chain_positions(
    origin: ArrayLike,
    q_world_segment: ArrayLike,
    lengths: ArrayLike,
    *,
    orientation_covariances: ArrayLike,
    length_sds: ArrayLike,
    origin_covariance: ArrayLike | None = None,
    axis: ArrayLike = DISTAL,
) -> ChainPositions:
    r"""Return the joints and what is known of their errors.

    .. math:: \Sigma_{P_{i+1}} = \Sigma_{P_i} + R_i [\ell_i]_\times \Sigma_i [\ell_i]_\times^T R_i^T
              + \sigma_{L_i}^2 u_i u_i^T, \qquad u_i = R_i \ell_i / |\ell_i|

    First order; errors of segments and lengths are taken as independent.

    Parameters
    ----------
    origin, q_world_segment, lengths, axis
        As for ``joint_positions``.
    orientation_covariances : array_like, shape (..., n, 3, 3)
        Of each segment's orientation in its own axes (perturbation on the right), rad^2.
    length_sds : array_like, shape (n,)
        m.
    origin_covariance : array_like, shape (..., 3, 3), optional
        Of O1, m^2; exact if None.
    """
    offsets = _offsets(lengths, axis)
    R = rotation.to_matrix(q_world_segment)
    lever = R @ rotation.skew(offsets)
    turned = lever @ np.asarray(orientation_covariances) @ np.swapaxes(lever, -1, -2)
    directions = R @ (offsets / np.linalg.norm(offsets, axis=-1, keepdims=True))[..., None]
    variances = np.asarray(length_sds, dtype=np.float64)[..., None, None] ** 2
    steps = turned + variances * (directions @ np.swapaxes(directions, -1, -2))
    first = np.zeros((3, 3)) if origin_covariance is None else np.asarray(origin_covariance)
    start = np.broadcast_to(first[..., None, :, :], (*steps.shape[:-3], 1, 3, 3))
    covariances = np.cumsum(np.concatenate((start, steps), axis=-3), axis=-3)
    return ChainPositions(joint_positions(origin, q_world_segment, lengths, axis), covariances)


def joint_positions_one(
    origin: Vector, q_world_segment: Sequence[Quaternion], offsets: Sequence[Vector]
) -> list[Vector]:
    """Return the joints of one frame of plain tuples, O1 first.

    Parameters
    ----------
    origin : tuple
        O1 in the world, m.
    q_world_segment : sequence of tuple
        Proximal segment first.
    offsets : sequence of tuple
        From the proximal to the distal joint of each segment, its own axes, m: (0, 0, -L).
    """
    x, y, z = origin
    joints = [origin]
    for q, offset in zip(q_world_segment, offsets, strict=True):
        dx, dy, dz = rotate_one(q, offset)
        x, y, z = x + dx, y + dy, z + dz
        joints.append((x, y, z))
    return joints


def _offsets(lengths: ArrayLike, axis: ArrayLike) -> Array:
    offsets: Array = np.asarray(lengths, dtype=np.float64)[..., None] * np.asarray(axis)
    return offsets
