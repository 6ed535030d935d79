r"""Levenberg-Marquardt search over many instants, each of which has its own damping.

Invariant: a step is accepted only at instants where the step lowers the cost. At other instants the
damping is increased. Converged instants take no further steps. If no damped step lowers the cost,
the search ends, but the instant has not converged. This happens where a joint is rotated by 180
degrees from the reference of a band (see below), because the penalty of the band jumps there.

In addition to the marker errors the cost contains *bands*, which penalize joint rotations outside a
range:

.. math:: \sum_k w_k \left(v_k - clip(v_k, low_k, high_k)\right)^2, \qquad
          v = \log(A_{ref}^T A)

where v is the rotation of each joint from the reference :math:`A_{ref}`, and w the weight. A band
of zero width restricts undetermined joints to the pose at the preceding instant. Other bands
restrict joints to their limits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chains import (
    ChainState,
    between_coordinates,
    layout_of,
    rest_state,
    step_state,
)
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import (
    MarkerFit,
    marker_fit,
    marker_slots,
    normal_equations,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainLayout, ChainModel

_DAMPING = 1e-4
"""Initial relative damping."""
_EASIER = 0.2
"""Factor by which the damping is multiplied after an accepted step."""
_HARDER = 8.0
"""Factor by which the damping is multiplied after a rejected step."""
_HOPELESS = 1e6
"""Damping above which the search at an instant ends without convergence. At a minimum of the cost
this damping is not reached, because smaller damping already reduces the steps below `_STILL`.
"""
_RIDGE = 1e-10
"""Absolute damping, for degrees of freedom without information."""
_STILL = 1e-8
"""Step, rad and m, below which an instant has converged, because only rounding errors remain."""


@dataclass(frozen=True, slots=True)
class Band:
    """Allowed range of joint rotations, with the weight of the excess over this range."""

    reference: ChainState
    """State with A_ref, at T instants or at one instant."""
    weights: Array
    """Weight of the squared excess, m^2/rad^2, shape (T, nq)."""
    low: Array
    """Lowest joint rotations relative to the reference, rad, shape (nq,)."""
    high: Array
    """Highest joint rotations relative to the reference, rad, shape (nq,)."""

    @classmethod
    def holding(cls, model: ChainModel, reference: ChainState, weights: Array) -> Band:
        """Return a band of zero width at `reference` for all joints except free joints."""
        layout = layout_of(model)
        joint = np.array([s.joint.kind != "free" for s in model.segments])[layout.segment_of]
        zero = np.zeros(layout.nq)
        return cls(reference, weights[:, None] * joint, zero, zero)

    def take(self, instants: NDArray[np.intp]) -> Band:
        """Return the band at some instants."""
        return replace(
            self, reference=self.reference.take(instants), weights=self.weights[instants]
        )

    def excess(self, layout: ChainLayout, state: ChainState) -> Array:
        """Return the excess of rotations over the band, rad, shape (T, nq)."""
        between = self.reference.rotations.swapaxes(-1, -2) @ state.rotations
        v = log_matrix(between).reshape(len(between), -1) @ layout.spread.T
        between_coordinates(layout, self.reference, state, v)
        return np.asarray(v - np.clip(v, self.low, self.high))


def limits_of(model: ChainModel, weight: float) -> tuple[Band, ...]:
    """Return the band of the model's joint limits; empty without limits or if the weight is 0."""
    joints = [s.joint for s in model.segments]
    low, high = np.full(model.nq, -np.inf), np.full(model.nq, np.inf)
    for joint, columns in zip(joints, model.columns, strict=True):
        if joint.kind in ("hinge", "coupled") and joint.limits is not None:
            low[columns], high[columns] = joint.limits
    # Coordinates of coupled joints are made relative to the rest state, like hinge angles.
    for _, column, curve in layout_of(model).coupled:
        low[column], high[column] = low[column] - curve.home, high[column] - curve.home
    limited = np.isfinite(low) | np.isfinite(high)
    if weight == 0.0 or not limited.any():
        return ()
    return (Band(rest_state(model), weight * limited[None], low, high),)


def log_matrix(R: Array) -> Array:
    """Return rotation vectors, rad, shape (..., 3), of matrices, shape (..., 3, 3).

    At the angle pi the direction of the vector is undefined.
    """
    v = 0.5 * np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]),
        axis=-1,
    )

    # the length of v is the sine of the angle; near zero, the ratio of angle to sine is 1
    sine = np.sqrt(np.einsum("...i,...i->...", v, v))
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    small = sine < 1e-9
    scale = np.where(small, 1.0, np.arctan2(sine, cosine) / np.where(small, 1.0, sine))
    return np.asarray(v * scale[..., None])


@dataclass(frozen=True, slots=True)
class PoseProblem:
    """Least-squares problem at T instants."""

    model: ChainModel
    measured: Array
    """Measured markers by segment, m, shape (T, S, 3, K), finite."""
    weights: Array
    """Weights of the squared errors, shape (T, S, K)."""
    tolerance: float
    iterations: int
    huber_m: float | None
    reweightings: int
    bands: tuple[Band, ...] = ()

    @property
    def typical_weight(self) -> float:
        """Median weight of the present markers; 1 if there are none."""
        weighing = self.weights[self.weights > 0.0]
        return float(np.median(weighing)) if weighing.size else 1.0

    def take(self, instants: NDArray[np.intp], hold: Band | None = None) -> PoseProblem:
        """Return the problem at some instants, with an additional band if given."""
        kept = tuple(b if len(b.weights) == 1 else b.take(instants) for b in self.bands)
        return replace(
            self,
            measured=self.measured[instants],
            weights=self.weights[instants],
            bands=kept if hold is None else (*kept, hold),
        )

    def at(self, state: ChainState) -> tuple[MarkerFit, Array]:
        """Return the fit of a state and its cost, m^2, shape (T,)."""
        found = marker_fit(marker_slots(self.model), state, self.measured, self.weights)
        cost = found.cost
        for band in self.bands:
            excess = band.excess(layout_of(self.model), state)
            cost = cost + np.einsum("tk,tk->t", band.weights * excess, excess)
        return found, cost

    def equations(self, state: ChainState, at: MarkerFit) -> tuple[Array, Array]:
        """Return the normal matrix, shape (T, nq, nq), and the gradient, shape (T, nq)."""
        H, g = normal_equations(marker_slots(self.model), at)
        for band in self.bands:
            excess = band.excess(layout_of(self.model), state)
            g = g + band.weights * excess
            diagonal = np.einsum("tkk->tk", H)
            diagonal += band.weights * ((excess != 0.0) | (band.low == band.high))
        return H, g


@dataclass(frozen=True, slots=True)
class PoseSolution:
    """Result of `find_poses`, which is the minimum at each instant."""

    state: ChainState
    weights: Array
    """Final weights, including robust factors, shape (T, S, K)."""
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


def find_poses(problem: PoseProblem, start: ChainState) -> PoseSolution:
    """Return the poses with the lowest cost, searched from `start`.

    The weights are robust if `PoseProblem.huber_m` is given.
    """
    found = _descend(problem, start)
    if problem.huber_m is None:
        return found

    # Errors above the Huber threshold get smaller weights, which move the minimum slightly.
    iterations = found.iterations
    for _ in range(problem.reweightings):
        errors = problem.at(found.state)[0].errors
        size = np.sqrt(np.einsum("tsik,tsik->tsk", errors, errors))
        factor = np.minimum(1.0, problem.huber_m / np.maximum(size, 1e-12))
        weighed = replace(problem, weights=problem.weights * factor)
        found = _descend(weighed, found.state)
        iterations = iterations + found.iterations
    return replace(found, iterations=iterations)


def _descend(problem: PoseProblem, start: ChainState) -> PoseSolution:
    count = len(start)
    found = start.copy()
    converged = np.zeros(count, dtype=np.bool_)
    iterations = np.zeros(count, dtype=np.intp)
    here = np.arange(count)
    state, part, damping = start, problem, np.full(count, _DAMPING)
    at, cost = part.at(state)
    layout = layout_of(problem.model)
    for _ in range(problem.iterations):
        H, g = part.equations(state, at)
        diagonal = np.einsum("tkk->tk", H)
        diagonal += damping[:, None] * diagonal + _RIDGE

        step = np.asarray(-np.linalg.solve(H, g[..., None])[..., 0], dtype=np.float64)
        onward = step_state(layout, state, step)
        there, new_cost = part.at(onward)

        better = new_cost < cost
        done = better & (cost - new_cost < problem.tolerance * cost)
        done |= np.abs(step).max(axis=-1) < _STILL
        damping = np.where(better, _EASIER, _HARDER) * damping
        given_up = damping > _HOPELESS
        iterations[here] += 1

        state, at = _select_better(better, (onward, there), (state, at))
        cost = np.where(better, new_cost, cost)
        ended = done | given_up
        if ended.any():
            found.put(here[ended], state.take(ended))
            converged[here[ended]] = done[ended]
            going = np.flatnonzero(~ended)
            here, state, part = here[going], state.take(going), part.take(going)
            at, cost, damping = at.take(going), cost[going], damping[going]
            if not len(here):
                break
    found.put(here, state)
    return PoseSolution(found, problem.weights, converged, iterations)


def _select_better(
    better: NDArray[np.bool_], new: tuple[ChainState, MarkerFit], old: tuple[ChainState, MarkerFit]
) -> tuple[ChainState, MarkerFit]:
    """Return the new state and fit at instants with a lower cost, and the old values elsewhere."""
    keep = better[:, None, None]
    (onward, there), (state, at) = new, old
    couplings = (
        None
        if onward.couplings is None or state.couplings is None
        else np.where(keep, onward.couplings, state.couplings)
    )
    state = ChainState(
        np.where(keep[..., None], onward.rotations, state.rotations),
        np.where(keep, onward.origins, state.origins),
        couplings,
    )

    pairs = ((there.world, at.world), (there.cloud, at.cloud), (there.weighted, at.weighted))
    world, cloud, weighted = (np.where(keep[..., None], n, o) for n, o in pairs)
    return state, MarkerFit(world, cloud, weighted, couplings)
