r"""Joints whose coordinates can be computed from a pose in closed form.

A joint of three successive rotations about perpendicular axes is

.. math:: A = A_0 \exp(q_1 b_1) \exp(q_2 b_2) \exp(q_3 b_3), \qquad
          B^T A_0^T A B = R_x(q_1) R_y(q_2) R_z(\pm q_3)

where q are the angles and the axes b are the columns of B. If B would be left-handed, the third
axis is reversed. A hinge has only the first rotation. A free joint also has an origin
:math:`t = t_0 + D q_t + A c` with translations :math:`q_t` and center c. All constants are computed
from the pose function of the joint, independent of the file format of the model.

Invariant: a joint has a closed form only if the closed form equals the pose function at all test
values.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import exp_matrix

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chain_coordinates import JointCoordinates
    from jointfit_daemon.kinematics.chains import JointKind

_PROBES = 8
_GOLDEN = 0.6180339887498949
"""Golden ratio minus 1. Its multiples modulo 1 are evenly distributed, and are used as test values
instead of random numbers.
"""
_SMALL = 0.1
"""Rotation angle that is used to compute an axis, rad."""
_EXACT = 1e-9
"""Largest accepted difference between a closed form and the pose function of the joint, rad and
m."""
_ANGLES = 3


@dataclass(frozen=True, slots=True)
class ClosedForm:
    """Constants of the closed form of one joint."""

    angles: tuple[int, ...]
    """Indices of the angles among the coordinates of the joint, in the order of the rotations."""
    signs: tuple[float, ...]
    """Sign of each angle. It is -1 if a positive angle is a negative rotation about the column of
    B.
    """
    left: Array
    """Matrix B^T A_0^T, shape (3, 3)."""
    basis: Array
    """Matrix B of the rotation axes, right-handed and orthonormal, shape (3, 3)."""
    shifts: tuple[int, ...] = ()
    """Indices of the translations of a free joint; empty for other joints."""
    shift_inverse: Array | None = None
    """Inverse of the matrix D of translation directions, shape (3, 3)."""
    start: Array | None = None
    """Origin t_0 at zero translations, m, shape (3,)."""
    center: Array | None = None
    """Center c of the rotations, m, shape (3,)."""

    def pose(self, values: Array) -> tuple[Array, Array]:
        """Return rotations, shape (n, 3, 3), and origins, m, shape (n, 3), of values (n, k)."""
        turned = np.broadcast_to(np.eye(3), (len(values), 3, 3))
        for axis, (k, sign) in enumerate(zip(self.angles, self.signs, strict=True)):
            turned = turned @ exp_matrix(sign * values[:, k, None] * np.eye(3)[axis])
        A = self.left.T @ turned @ self.basis.T
        if self.shift_inverse is None or self.start is None or self.center is None:
            return A, np.zeros((len(values), 3))
        along = values[:, list(self.shifts)] @ np.linalg.inv(self.shift_inverse).T
        return A, self.start + along + A @ self.center


def closed_form(joint: JointCoordinates, kind: JointKind) -> ClosedForm | None:
    """Return the closed form of a joint; None if the joint has no closed form.

    Parameters
    ----------
    joint
        Coordinates of the joint, and the pose of the joint as a function of these coordinates.
    kind
        Kind of the joint in the chain.
    """
    angles = [k for k, is_angle in enumerate(joint.is_angle) if is_angle]
    shifts = [k for k, is_angle in enumerate(joint.is_angle) if not is_angle]
    wanted = {"hinge": (1, 0), "ball": (_ANGLES, 0), "free": (_ANGLES, 3)}
    if joint.pose is None or (len(angles), len(shifts)) != wanted.get(kind):
        return None

    # A candidate must be exact at evenly distributed values of all coordinates.
    count = len(joint.names)
    numbers = np.arange(1, _PROBES + 1)[:, None] * np.arange(1, count + 1) * _GOLDEN
    probes: Array = np.asarray(2.0 * (2.0 * (numbers % 1.0) - 1.0), dtype=np.float64)
    expected = joint.pose(probes)
    for order in permutations(angles):
        found = _candidate(joint, order, shifts)
        if found is None:
            continue
        A, t = found.pose(probes)
        off = float(np.abs(A - expected[0]).max())
        if shifts:  # only a free joint has its own origin; the parent determines other origins
            off = max(off, float(np.abs(t - expected[1]).max()))
        second = order[1] if len(order) == _ANGLES else None
        if off < _EXACT and joint.middle in (None, second):
            return found
    return None


def _candidate(
    joint: JointCoordinates, order: tuple[int, ...], shifts: list[int]
) -> ClosedForm | None:
    """Return the closed form for an order of rotations; None if the axes are not perpendicular."""
    if joint.pose is None:
        return None

    # Change one coordinate at a time to compute its axis.
    at = np.zeros((1 + len(joint.names), len(joint.names)))
    at[1:] = np.diag(np.where(joint.is_angle, _SMALL, 1.0))
    A, t = joint.pose(at)
    axes = rotation.log(rotation.from_matrix(A[0].T @ A[1:])) / _SMALL
    units = [axes[k] for k in order]
    if max(abs(float(np.linalg.norm(unit)) - 1.0) for unit in units) > _EXACT:
        return None
    signs = [1.0] * len(order)
    if len(order) == _ANGLES:
        # the third axis of a left-handed sequence is reversed
        signs[2] = float(np.sign(np.cross(units[0], units[1]) @ units[2]))
        basis = np.column_stack((units[0], units[1], signs[2] * units[2]))
    else:
        basis = np.linalg.svd(units[0][None])[2].T
        basis[:, 2] *= np.sign(np.linalg.det(basis))
        signs[0] = float(np.sign(basis[:, 0] @ units[0]))
    if np.abs(basis.T @ basis - np.eye(3)).max() > _EXACT:
        return None

    left = basis.T @ A[0].T
    if not shifts:
        return ClosedForm(order, tuple(signs), left, basis)

    # Translations move the origin by D q_t, and rotations by A c.
    D = np.stack([t[1 + k] - t[0] for k in shifts], axis=1)
    rows = [1 + k for k in order]
    center = np.linalg.lstsq((A[rows] - A[0]).reshape(-1, 3), (t[rows] - t[0]).ravel(), rcond=None)[
        0
    ]
    if abs(np.linalg.det(D)) < _EXACT:
        return None
    start = t[0] - A[0] @ center
    return ClosedForm(
        order, tuple(signs), left, basis, tuple(shifts), np.linalg.inv(D), start, center
    )
