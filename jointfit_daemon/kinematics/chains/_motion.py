r"""Poses of the segments and markers of a chain, their Jacobian, and steps.

The first axis of all arrays has the length T, the number of instants. A step δ moves a state on its
manifold,

.. math:: A_i \leftarrow A_i \exp(\delta_i), \qquad t_{root} \leftarrow t_{root} + \delta_t

`ChainModel.columns` defines the columns of :math:`\delta`. The columns of a segment are rotations
in its own axes, rad. A free segment also has the translation of its origin in the world, m. The
column of a coupled joint is the step of its coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains._coupled_joint import COLUMNS
from jointfit_daemon.kinematics.chains._layout import LEVI, ChainLayout, layout_of
from jointfit_daemon.kinematics.chains._model import ChainModel, rest_rotations

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array


_TINY = 1e-30  # rad^2, far below rounding; avoids 0/0 in sin(x)/x
_EYE = np.eye(3)


@dataclass(frozen=True, slots=True)
class ChainState:
    """State of all joints of a chain at T instants."""

    rotations: Array
    """A_i = R_parent_segment (R_world_segment without a parent), shape (T, S, 3, 3)."""
    origins: Array
    """World origins of the F free segments, in the order of the model, m, shape (T, F, 3)."""
    couplings: Array | None = None
    """Coordinates and derivatives of the C coupled joints, in the order of the model, as returned
    by `CoupledCurve.at`, shape (T, C, 10). None without coupled joints.
    """

    def __len__(self) -> int:
        return len(self.rotations)

    def take(self, instants: NDArray[np.intp] | NDArray[np.bool_] | slice) -> ChainState:
        """Return the state at the selected instants."""
        some = None if self.couplings is None else self.couplings[instants]
        return ChainState(self.rotations[instants], self.origins[instants], some)

    def put(self, instants: NDArray[np.intp], other: ChainState) -> None:
        """Overwrite the state at the selected instants, in place."""
        self.rotations[instants], self.origins[instants] = other.rotations, other.origins
        if self.couplings is not None:
            self.couplings[instants] = other.couplings

    def copy(self) -> ChainState:
        """Return a copy with its own arrays."""
        return self.take(np.arange(len(self)))


def rest_state(model: ChainModel, count: int = 1) -> ChainState:
    """Return the chain at rest at `count` instants, with free origins at the world origin."""
    free = sum(s.joint.kind == "free" for s in model.segments)
    rest = np.broadcast_to(rest_rotations(model), (count, len(model.segments), 3, 3))
    return place_coupled(layout_of(model), rest.copy(), np.zeros((count, free, 3)), None)


def segment_poses(model: ChainModel, state: ChainState) -> tuple[Array, Array]:
    """Return R_world_segment, shape (T, S, 3, 3), and world origins, m, shape (T, S, 3)."""
    world = transforms(layout_of(model), state)
    return world[..., :3, :3], world[..., :3, 3]


def transforms(layout: ChainLayout, state: ChainState) -> Array:
    """Return each segment's transform to the world, shape (T, S, 4, 4), level by level."""
    rotations = state.rotations
    local = np.empty((*rotations.shape[:2], 4, 4))
    local[:] = layout.corners
    local[..., :3, :3] = rotations
    if layout.has_own_centers:
        local[..., :3, 3] -= (rotations @ layout.center[:, :, None])[..., 0]
    local[..., :3, 3][:, layout.free] = state.origins

    # apply the paths of coupled joints, then multiply from the root outwards
    if state.couplings is not None:
        for c, (segment, _, _) in enumerate(layout.coupled):
            local[:, segment, :3, 3] += state.couplings[:, c, 1:4]
    for level, parents in layout.levels:
        local[:, level] = local[:, parents] @ local[:, level]
    return local


def marker_positions(model: ChainModel, state: ChainState) -> Array:
    """Return the markers in the world, m, shape (T, M, 3)."""
    R, t = segment_poses(model, state)
    s = model.marker_segments
    placed: Array = (R[:, s] @ model.positions[:, :, None])[..., 0] + t[:, s]
    return placed


def twists(layout: ChainLayout, world: Array, couplings: Array | None = None) -> Array:
    r"""Return the twist of each degree of freedom, shape (T, nq, 6).

    The row of a degree of freedom is :math:`(\alpha, \beta)`, and moves a point x by
    :math:`\alpha\times x + \beta`. For a rotation about the world axis :math:`\alpha` through C,
    :math:`\beta = C \times \alpha`. The twist of a coupled joint also contains its translation in
    :math:`\beta`.
    """
    found = np.empty((len(world), layout.nq, 6))

    turns = world[:, layout.segment_of, :3] @ layout.turns
    if couplings is not None:
        for c, (segment, column, _) in enumerate(layout.coupled):
            own = world[:, segment, :3, :3]
            turns[:, column, :, 0] = (own @ couplings[:, c, 4:7, None])[..., 0]

    found[..., :3] = turns[..., 0]
    found[..., 3:] = (skew(turns[..., 1]) @ turns[..., :1])[..., 0]
    if couplings is not None:
        for c, (segment, column, _) in enumerate(layout.coupled):
            own = world[:, segment, :3, :3]
            found[:, column, 3:] += (own @ couplings[:, c, 7:, None])[..., 0]
    found[:, layout.shifts] = layout.shift_twists
    return found


def skew(v: Array) -> Array:
    """Return cross-product matrices, shape (..., 3, 3), by one matrix product."""
    return (v @ LEVI).reshape(*v.shape[:-1], 3, 3)


def jacobian(model: ChainModel, state: ChainState) -> Array:
    r"""Return d(marker)/d(step), shape (T, M, 3, nq).

    .. math:: \partial x_m/\partial q_k = \alpha_k \times (x_m - C_k)

    where α is the world axis of the rotation and C a point on this axis. The equation applies to
    the rotations of all joints between the world and the marker's segment. For a coupled joint, the
    translation along its path is added. The derivative is the identity for translations of the root
    of the chain, and zero for all other degrees of freedom.
    """
    layout = layout_of(model)
    world = transforms(layout, state)
    s = model.marker_segments
    x = (world[:, s, :3, :3] @ model.positions[:, :, None])[..., 0] + world[..., :3, 3][:, s]
    motion = twists(layout, world, state.couplings)

    # alpha x X + beta is computed as one product, [skew(alpha), beta] times (X, 1).
    maps = np.empty((len(world), layout.nq, 3, 4))
    maps[..., :3] = skew(motion[..., :3])
    maps[..., 3] = motion[..., 3:]
    points = np.concatenate((x, np.ones_like(x[..., :1])), axis=-1)
    moved = maps.reshape(len(world), -1, 4) @ np.swapaxes(points, -1, -2)
    J = moved.reshape(len(world), layout.nq, 3, len(s)).transpose(0, 3, 2, 1)
    return J * layout.moves[s][:, None, :]


def apply_step(model: ChainModel, state: ChainState, delta: Array) -> ChainState:
    """Return the state after the step `delta`, rad and m, shape (T, nq)."""
    return step_state(layout_of(model), state, delta)


def step_state(layout: ChainLayout, state: ChainState, delta: Array) -> ChainState:
    """Return the state after the step `delta`, shape (T, nq)."""
    vectors = (delta @ layout.spread).reshape(*state.rotations.shape[:2], 3)
    exp = exp_matrix if len(vectors) > 1 else _exp_of_few
    rotations = state.rotations @ exp(vectors)
    origins = state.origins + delta[:, layout.shifts].reshape(len(delta), -1, 3)
    if state.couplings is None:
        return ChainState(rotations, origins)
    columns = [column for _, column, _ in layout.coupled]
    return place_coupled(layout, rotations, origins, state.couplings[..., 0] + delta[:, columns])


def place_coupled(
    layout: ChainLayout, rotations: Array, origins: Array, amounts: Array | None
) -> ChainState:
    """Return a state with coupled joints placed by their coordinates.

    Parameters
    ----------
    rotations, origins
        Fields of `ChainState`. Rotations of coupled joints are overwritten in place.
    amounts
        Coordinates of the coupled joints, rad, shape (T, C); coordinates at rest if None.
    """
    if not layout.coupled:
        return ChainState(rotations, origins)
    found = np.empty((len(rotations), len(layout.coupled), COLUMNS))
    for c, (segment, _, curve) in enumerate(layout.coupled):
        q = np.full(len(rotations), curve.home) if amounts is None else amounts[:, c]
        rotations[:, segment], found[:, c] = curve.at(q)
    return ChainState(rotations, origins, found)


def exp_matrix(r: Array) -> Array:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad.

    The formula of Rodrigues is I + sin(x)/x K + (1 - cos x)/x^2 K^2, where x is the angle and K the
    cross-product matrix of the vector.
    """
    K = skew(r)
    angle = np.sqrt(np.einsum("...i,...i->...", r, r) + _TINY)[..., None, None]
    half = np.sin(0.5 * angle) / angle
    turn = (np.sin(angle) / angle) * K + (2.0 * half * half) * (K @ K)
    turn += _EYE
    return np.asarray(turn)


def _exp_of_few(r: Array) -> Array:
    """Return `exp_matrix(r)` with plain floats, which is faster for a few vectors."""
    rows = []
    for x, y, z in r.reshape(-1, 3).tolist():
        angle = sqrt(x * x + y * y + z * z + _TINY)
        s, half = sin(angle) / angle, sin(0.5 * angle) / angle
        c = 2.0 * half * half
        cx, cy, cz = c * x, c * y, c * z
        xy, xz, yz = cx * y, cx * z, cy * z
        sx, sy, sz = s * x, s * y, s * z
        xx, yy, zz = cx * x, cy * y, cz * z
        rows.append(
            (1 - yy - zz, xy - sz, xz + sy, xy + sz, 1 - xx - zz, yz - sx, xz - sy, yz + sx,
             1 - xx - yy)
        )  # fmt: skip
    return np.array(rows).reshape(*r.shape, 3)


def step_between(model: ChainModel, a: ChainState, b: ChainState) -> Array:
    """Return the step, shape (T, nq), that takes state a to state b by `apply_step`.

    The step of a joint is log(A_a^T A_b). For a hinge it is the component of this vector about the
    hinge axis, and for a coupled joint the difference of the coordinates.
    """
    layout = layout_of(model)
    between = rotation.from_matrix(np.swapaxes(a.rotations, -1, -2) @ b.rotations)
    vectors = rotation.log(between).reshape(len(between), -1)
    step: Array = vectors @ layout.spread.T
    between_coordinates(layout, a, b, step)
    step[:, layout.shifts] = (b.origins - a.origins).reshape(len(step), -1)
    return step


def between_coordinates(layout: ChainLayout, a: ChainState, b: ChainState, step: Array) -> None:
    """Write the coordinate differences of coupled joints from a to b into `step`."""
    if a.couplings is not None and b.couplings is not None:
        columns = [column for _, column, _ in layout.coupled]
        step[:, columns] = b.couplings[..., 0] - a.couplings[..., 0]
