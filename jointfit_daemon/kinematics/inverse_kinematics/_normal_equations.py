r"""Normal equations of the marker errors, from sums over the markers of each segment.

With the twists :math:`S_k=(\alpha_k,\beta_k)` of the degrees of freedom, a marker cloud contributes
:math:`S_k^T I S_l` to the normal matrix, where

.. math:: I = \sum_m w_m \begin{pmatrix} |x|^2 1 - x x^T & [x]_\times \\ -[x]_\times & 1
          \end{pmatrix}

The sum is over the markers m that both degrees of freedom, k and l, move. A marker has the position
x and the weight w. Only one sum over markers per instant is needed. All other operations are on
segments and degrees of freedom, as in the composite rigid body algorithm with markers as masses.
Source: Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2.

Internally the markers of each segment are stored in K slots, shape (T, S, 3, K). Empty slots have
the weight zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chains import ChainLayout, layout_of, transforms, twists

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState


@dataclass(frozen=True, slots=True)
class MarkerSlots:
    """Index of each marker of a model in arrays (T, S, 3, K)."""

    layout: ChainLayout
    points: Array
    """(x, y, z, 1) of each slot in segment axes, shape (S, 4, K)."""
    places: NDArray[np.intp]
    """Flat index of each marker in (S, K); shape (M,)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of segments S and of slots K."""
        return self.points.shape[0], self.points.shape[2]

    def to_slots(self, values: Array) -> Array:
        """Return values of shape (T, M) in slots, shape (T, S, K), zero in empty slots."""
        out = np.zeros((len(values), self.shape[0] * self.shape[1]))
        out[:, self.places] = values
        return out.reshape(len(values), *self.shape)

    def vectors_to_slots(self, values: Array) -> Array:
        """Return vectors of shape (T, M, 3) in slots, shape (T, S, 3, K), zero in empty slots."""
        out = np.zeros((len(values), self.shape[0] * self.shape[1], 3))
        out[:, self.places] = values
        return np.ascontiguousarray(out.reshape(len(values), *self.shape, 3).swapaxes(-1, -2))

    def from_slots(self, slots: Array) -> Array:
        """Return vectors in slots, shape (T, S, 3, K), in the order of the markers, (T, M, 3)."""
        flat = slots.swapaxes(-1, -2).reshape(len(slots), -1, 3)
        return np.asarray(flat[:, self.places])


def marker_slots(model: ChainModel) -> MarkerSlots:
    """Return the slots of a model's markers, cached in the model."""
    kept = model.__dict__.get("_slots")
    if not isinstance(kept, MarkerSlots):
        kept = _slots(model)
        model.__dict__["_slots"] = kept
    return kept


def _slots(model: ChainModel) -> MarkerSlots:
    segments = model.marker_segments
    count = np.bincount(segments, minlength=len(model.segments))
    width = max(int(count.max(initial=0)), 1)
    order = np.array([int((segments[:m] == s).sum()) for m, s in enumerate(segments)])
    points = np.zeros((len(model.segments), 4, width))
    points[:, 3] = 1.0
    points[segments, :3, order.astype(np.intp)] = model.positions
    return MarkerSlots(layout_of(model), points, (segments * width + order).astype(np.intp))


@dataclass(frozen=True, slots=True)
class MarkerFit:
    """Poses of a chain at T instants, with the marker errors."""

    world: Array
    """Transforms of the segments, shape (T, S, 4, 4)."""
    cloud: Array
    """Rows x, y, z, 1 of each model marker, and three rows with the errors of the marker, shape (T,
    S, 7, K).
    """
    weighted: Array
    """Array ``cloud`` multiplied by the marker weights."""
    couplings: Array | None = None
    """Field `couplings` of the state."""

    @property
    def errors(self) -> Array:
        """Marker position of the model minus measured position, m, shape (T, S, 3, K)."""
        return self.cloud[..., 4:, :]

    @property
    def cost(self) -> Array:
        """Sum of the weighted squared errors, m^2, shape (T,)."""
        return np.asarray(
            np.einsum("tsik,tsik->t", self.cloud[..., 4:, :], self.weighted[..., 4:, :])
        )

    def with_weights(self, weights: Array) -> MarkerFit:
        """Return the fit with other weights, shape (T, S, K)."""
        weighted = self.cloud * weights[:, :, None, :]
        return MarkerFit(self.world, self.cloud, weighted, self.couplings)

    def take(self, instants: NDArray[np.intp]) -> MarkerFit:
        """Return the fit at some instants."""
        some = None if self.couplings is None else self.couplings[instants]
        return MarkerFit(self.world[instants], self.cloud[instants], self.weighted[instants], some)


def marker_fit(slots: MarkerSlots, state: ChainState, measured: Array, weights: Array) -> MarkerFit:
    """Return the fit with the marker errors of a state.

    Parameters
    ----------
    slots
        Marker slots of the model.
    state
        State of the chain.
    measured
        Measured positions, m, shape (T, S, 3, K), finite.
    weights
        Weights of the markers, shape (T, S, K), zero where markers are missing.
    """
    world = transforms(slots.layout, state)
    cloud = np.empty((*world.shape[:2], 7, slots.shape[1]))
    np.matmul(world, slots.points, out=cloud[..., :4, :])
    np.subtract(cloud[..., :3, :], measured, out=cloud[..., 4:, :])
    return MarkerFit(world, cloud, cloud * weights[:, :, None, :], state.couplings)


def _sums_to_inertia() -> Array:
    """Return the matrix that maps sums over the markers of a segment to I and to the gradient.

    The sums are w (x, y, z, 1) (x, y, z, 1, e)^T for markers with the position x, the error e and
    the weight w. The result has the shape (28, 42). It maps the 28 sums to a 6 x 7 matrix, which
    contains I in six columns and the sums of w (x × e, e) in the last column.
    """
    out = np.zeros((4, 7, 6, 7))
    cross = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    for i, j, k in cross:
        for other in (j, k):
            out[other, other, i, i] += 1.0
            out[i, other, i, other] -= 1.0
        out[i, 3, k, 3 + j] += 1.0  # [s]x at (k, j) is s_i
        out[i, 3, j, 3 + k] -= 1.0
        out[i, 3, 3 + k, j] -= 1.0
        out[i, 3, 3 + j, k] += 1.0
        out[3, 3, 3 + i, 3 + i] += 1.0
        out[j, 4 + k, i, 6] += 1.0
        out[k, 4 + j, i, 6] -= 1.0
        out[3, 4 + i, 3 + i, 6] += 1.0
    return out.reshape(28, 42)


_INERTIA = _sums_to_inertia()


def normal_equations(slots: MarkerSlots, at: MarkerFit) -> tuple[Array, Array]:
    """Return J^T W J, shape (T, nq, nq), and J^T W e, shape (T, nq)."""
    lower, g = lower_equations(slots, at)
    return lower + (lower * slots.layout.strictly_lower).swapaxes(-1, -2), g


def lower_equations(slots: MarkerSlots, at: MarkerFit) -> tuple[Array, Array]:
    """Return the lower triangle of J^T W J, for a Cholesky decomposition, and J^T W e."""
    layout, count = slots.layout, len(at.world)
    sums = at.cloud[..., :4, :] @ at.weighted.swapaxes(-1, -2)
    beyond = layout.below @ sums.reshape(count, -1, 28)
    bodies = (beyond @ _INERTIA).reshape(count, -1, 6, 7)
    motion = twists(layout, at.world, at.couplings)

    # A loop over segments needs less memory than the inertia of all degrees of freedom at once.
    pushed = np.empty((*motion.shape[:2], 7))
    for s, columns in layout.columns:
        np.matmul(motion[:, columns], bodies[:, s], out=pushed[:, columns])
    lower = (pushed[..., :6] @ motion.swapaxes(-1, -2)) * layout.lower
    return lower, pushed[..., 6]
