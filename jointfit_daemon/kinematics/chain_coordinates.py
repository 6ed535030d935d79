r"""Values and standard deviations of named joint coordinates, such as ``hip_flexion_r``.

The state of a chain contains a rotation matrix A for each joint. The coordinates q of the joint
determine this matrix by a function, A = f(q). This module inverts f by Gauss-Newton steps on the
manifold,

.. math:: q \leftarrow q + G^{+}\,\log(f(q)^{-1} A), \qquad G = \partial\log / \partial q

:math:`G^{+}` is the pseudo-inverse of G. The covariance of the coordinates is :math:`G^{+} C
G^{+T}`, where C is the covariance of a step of this joint. A step of the chain state
(`chains.apply_step`) contains for each joint the rotation vector, in the axes of the segment, by
which A is rotated. For a free joint it also contains the translation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import exp_matrix

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState, Joint

_ITERATIONS = 30
_LARGEST_STEP = 0.2
"""Largest step of an angle, rad. Near a gimbal lock longer steps would lead to other solutions."""
_CONVERGED = 1e-10
"""Length of a step below which the inversion has converged, rad and m."""
_DIFFERENCE = 1e-5
"""Half the interval of a central difference, rad and m; the derivative has an error of about
1e-10."""
_RIDGE = 1e-12
"""Regularization that is added to G^T G, so that angles are finite at a gimbal lock."""
_TRIED = 24
"""Number of start angles per coordinate in an inversion, which are 15 degrees apart."""
_TOGETHER = 250
"""Number of instants that are compared with the start poses at once, which limits the memory."""
_THREE_ANGLES = 3


@dataclass(frozen=True, slots=True)
class JointCoordinates:
    """Coordinates of one segment relative to its parent, or to the world if it has a free joint."""

    segment: str
    names: tuple[str, ...]
    is_angle: tuple[bool, ...]
    """True for each coordinate that is an angle, rad; False for a translation, m."""
    pose: Callable[[Array], tuple[Array, Array]] | None
    """Function that maps values, shape (n, k), to the rotation A_i of `ChainState`, shape (n, 3,
    3), and to the world origin of a free segment, m, shape (n, 3). None for a coupled joint, whose
    coordinate is part of the state.
    """
    middle: int | None = None
    """Index of the second of three successive rotations, whose angle is limited to ±90 degrees;
    None for other joints."""


def default_coordinates(model: ChainModel) -> tuple[JointCoordinates, ...]:
    """Return coordinates with default names for a model that does not name its coordinates.

    A hinge or coupled joint has ``NAME_angle``, rad. Ball and free joints have ``NAME_rx``,
    ``NAME_ry`` and ``NAME_rz``, rad, with R = Rx Ry Rz. A free joint also has ``NAME_tx``,
    ``NAME_ty`` and ``NAME_tz``, m, in the world with z up.
    """
    found = []
    for segment in model.segments:
        name, joint = segment.name, segment.joint
        if joint.kind in {"hinge", "coupled"}:
            pose = partial(_hinge_pose, joint) if joint.kind == "hinge" else None
            found.append(JointCoordinates(name, (f"{name}_angle",), (True,), pose))
        else:
            found.append(euler_coordinates(name, is_free=joint.kind == "free"))
    return tuple(found)


def _hinge_pose(joint: Joint, values: Array) -> tuple[Array, Array]:
    turned = exp_matrix(values * np.asarray(joint.axis))
    return rotation.to_matrix(np.asarray(joint.rest)) @ turned, np.zeros((len(values), 3))


def euler_coordinates(
    name: str, *, is_free: bool, order: tuple[int, int, int] = (0, 1, 2)
) -> JointCoordinates:
    """Return three angles (and three translations of a free segment) as in `default_coordinates`.

    Parameters
    ----------
    name
        Name of the segment, which is the first part of the coordinate names.
    is_free
        Whether the joint has translations.
    order
        Indices of the chain's axes that a file calls x, y and z.
    """

    def pose(values: Array) -> tuple[Array, Array]:
        axes = np.eye(3)[list(order)]
        x, y, z = (exp_matrix(values[:, k, None] * axes[k]) for k in range(3))
        shift = values[:, 3:] @ axes if is_free else np.zeros((len(values), 3))
        return x @ y @ z, shift

    parts = ("rx", "ry", "rz", *(("tx", "ty", "tz") if is_free else ()))
    angles = tuple(part.startswith("r") for part in parts)
    return JointCoordinates(name, tuple(f"{name}_{p}" for p in parts), angles, pose, middle=1)


@dataclass(frozen=True, slots=True)
class CoordinateTable:
    """Values of K coordinates at T instants."""

    names: tuple[str, ...]
    is_angle: tuple[bool, ...]
    values: Array
    """Value of each coordinate, rad and m, shape (T, K); angles are continuous over time."""
    sd: Array
    """Standard deviations, rad and m, shape (T, K)."""
    misfit: dict[str, float]
    """Largest rotation at any instant that the coordinates of a segment cannot describe, rad, by
    segment name. Coupled joints have no entry.
    """


def coordinate_table(
    model: ChainModel,
    state: ChainState,
    covariance: Array,
    coordinates: tuple[JointCoordinates, ...],
    known: NDArray[np.bool_] | None = None,
) -> CoordinateTable:
    """Return the coordinates of a state.

    Parameters
    ----------
    model
        The chain.
    state
        State of the chain at T instants.
    covariance
        Covariance of a step of the state (`chains.apply_step`), rad^2 and m^2, shape (T, nq, nq).
    coordinates
        One entry for each segment, in the order of the model.
    known
        Mask of the values that the measurement determines, shape (T, K); all if None. Angles are
        made continuous over these values only, because undetermined values are arbitrary.
    """
    values, sd, misfit, coupled, column = [], [], {}, 0, 0
    count = sum(len(joint.names) for joint in coordinates)
    known = np.ones((len(state), count), np.bool_) if known is None else known
    for i, (joint, segment) in enumerate(zip(coordinates, model.segments, strict=True)):
        block = covariance[:, model.columns[i], model.columns[i]]
        determined = np.asarray(known[:, column : column + len(joint.names)].all(axis=1))
        column += len(joint.names)
        if joint.pose is None and state.couplings is not None:
            values.append(state.couplings[:, coupled, :1])
            sd.append(np.sqrt(block[:, :, 0]))
            coupled += 1
            continue

        free = sum(s.joint.kind == "free" for s in model.segments[:i])
        is_free = segment.joint.kind == "free"
        origin = state.origins[:, free] if is_free else np.zeros((len(state), 3))
        found, G, left = _invert_joint(joint, state.rotations[:, i], origin, is_free=is_free)
        values.append(_continuous(found, joint.is_angle, determined))

        # a step has one angle for a hinge, three rotations for a ball joint, and six values for a
        # free joint
        step = np.asarray(segment.joint.axis)[:, None] if segment.joint.kind == "hinge" else None
        P = _pseudo_inverse(G) if step is None else _pseudo_inverse(G) @ step
        sd.append(np.sqrt(np.einsum("tkj,tjl,tkl->tk", P, block, P)))
        misfit[segment.name] = left

    return CoordinateTable(
        tuple(name for joint in coordinates for name in joint.names),
        tuple(angle for joint in coordinates for angle in joint.is_angle),
        np.concatenate(values, axis=1),
        np.concatenate(sd, axis=1),
        misfit,
    )


def _invert_joint(
    joint: JointCoordinates, A: Array, origin: Array, *, is_free: bool
) -> tuple[Array, Array, float]:
    """Return the values, shape (T, k), the derivative G, (T, 3 or 6, k), and the misfit, rad."""
    rows = 6 if is_free else 3
    values, turning = _start(joint, A), np.flatnonzero(joint.is_angle)
    for _ in range(_ITERATIONS):
        G = _derivative(joint, values)[:, :rows]
        missing = _difference(joint, values, A, origin)
        step = (_pseudo_inverse(G) @ missing[:, :rows, None])[..., 0]
        turned = np.abs(step[:, turning]).max(axis=1, keepdims=True, initial=0.0)
        step[:, turning] *= np.minimum(1.0, _LARGEST_STEP / np.maximum(turned, _CONVERGED))
        values = values + step
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break

    left = np.linalg.norm(_difference(joint, values, A, origin)[:, :3], axis=-1)
    return values, _derivative(joint, values)[:, :rows], float(left.max(initial=0.0))


def _pose(joint: JointCoordinates, values: Array) -> tuple[Array, Array]:
    if joint.pose is None:
        raise ValueError(f"{joint.segment}: its coordinate is part of the state")
    return joint.pose(values)


def _start(joint: JointCoordinates, A: Array) -> Array:
    """Return the start angles whose rotation is nearest to A, and zero for translations."""
    turn = np.arange(_TRIED) * (2.0 * np.pi / _TRIED) - np.pi
    turning = np.flatnonzero(joint.is_angle)
    if not turning.size:
        return np.zeros((len(A), len(joint.names)))
    half = turn[np.abs(turn) < 0.5 * np.pi - 1e-9]
    is_euler = len(turning) == _THREE_ANGLES
    tried = [half if is_euler and k == joint.middle else turn for k in turning]

    grid = np.zeros((int(np.prod([len(t) for t in tried])), len(joint.names)))
    grid[:, turning] = np.stack(np.meshgrid(*tried, indexing="ij"), axis=-1).reshape(-1, len(tried))
    poses = _pose(joint, grid)[0].reshape(-1, 9)
    parts = np.array_split(A.reshape(-1, 9), len(A) // _TOGETHER + 1)
    nearest: NDArray[np.intp] = np.concatenate([(p @ poses.T).argmax(axis=1) for p in parts])
    return np.asarray(grid[nearest])


def _difference(joint: JointCoordinates, values: Array, A: Array, origin: Array) -> Array:
    """Return the step from the pose at `values` to (A, origin), shape (T, 6)."""
    return _step(*_pose(joint, values), A, origin)


def _step(R: Array, t: Array, to_R: Array, to_t: Array) -> Array:
    turned = rotation.log(rotation.from_matrix(R.swapaxes(-1, -2) @ to_R))
    step: Array = np.concatenate((turned, to_t - t), axis=-1)
    return step


def _derivative(joint: JointCoordinates, values: Array) -> Array:
    """Return d(step)/d(values), shape (T, 6, k), from central differences."""
    columns = []
    for k in range(values.shape[1]):
        shift = _DIFFERENCE * np.eye(values.shape[1])[k]
        below, above = _pose(joint, values - shift), _pose(joint, values + shift)
        columns.append(_step(*below, *above) / (2.0 * _DIFFERENCE))
    G: Array = np.stack(columns, axis=-1)
    return G


def _pseudo_inverse(G: Array) -> Array:
    square = G.swapaxes(-1, -2) @ G + _RIDGE * np.eye(G.shape[-1])
    return np.asarray(np.linalg.solve(square, G.swapaxes(-1, -2)))


def _continuous(values: Array, is_angle: tuple[bool, ...], known: NDArray[np.bool_]) -> Array:
    """Return values without jumps of 360 degrees between successive known rows.

    `known` is the mask of these rows, shape (T,). The median of each angle in these rows is between
    -180 and 180 degrees. Other rows are returned unchanged.
    """
    if not known.any():
        return values
    found = values.copy()
    cells = np.ix_(known, np.array(is_angle))
    angles = np.unwrap(values[cells], axis=0)
    turns = np.round(np.median(angles, axis=0) / (2.0 * np.pi))
    found[cells] = angles - 2.0 * np.pi * turns
    return found
