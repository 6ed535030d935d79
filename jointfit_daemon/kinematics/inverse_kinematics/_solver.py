r"""Inverse kinematics of a chain from measured markers, for all instants of a trial.

At every instant

.. math:: q_t = \arg\min_q \sum_m w_{tm} |x_m(q) - y_{tm}|^2

is computed by the Levenberg-Marquardt method, where x are marker positions of the model, y measured
positions and w weights. All instants are solved in parallel, each with its own damping. Missing
markers (NaN) have the weight 0. If the markers do not determine a degree of freedom at an instant,
the result marks this instant. A second pass solves these instants again, in order of time. The
search at each of them starts from the preceding pose and is regularized toward this pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.inverse_kinematics._initial_pose import start_from_markers
from jointfit_daemon.kinematics.inverse_kinematics._levenberg_marquardt import (
    Band,
    PoseProblem,
    find_poses,
    limits_of,
)
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import (
    marker_fit,
    marker_slots,
    normal_equations,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState

_TOGETHER = 4096
"""Number of degrees of freedom that are solved together, so that their arrays fit in the processor
cache.
"""
OPEN_M2 = 4e-4
"""Information, m^2/rad^2, below which a degree of freedom is undetermined. It is (2 cm)²."""


@dataclass(frozen=True, slots=True)
class IkOptions:
    """Options of the solver; the defaults are for skin-mounted markers."""

    iterations: int = 60
    """Largest number of iterations per instant and per set of robust weights."""
    tolerance: float = 1e-7
    """Relative decrease of the squared error at which an instant has converged."""
    huber_m: float | None = None
    """Huber threshold c of the marker error, m. Errors e above c have the weight c/|e|. None is a
    least-squares fit.
    """
    reweightings: int = 2
    """Number of passes with updated robust weights."""
    hold_m2: float = 1e-4
    """Weight of the pose at the preceding instant for joints that the markers do not determine,
    m^2/rad^2.
    """
    limit_m2: float = 0.0
    """Weight of the squared excess over a joint's limits, m^2/rad^2; 0 ignores the limits."""


@dataclass(frozen=True, slots=True)
class IkResult:
    """Poses of S segments at T instants, with the errors of M markers."""

    state: ChainState
    rotations: Array
    """R_world_segment, shape (T, S, 3, 3)."""
    origins: Array
    """World origins of the segments, m, shape (T, S, 3)."""
    residuals: Array
    """Marker position of the model minus measured position, m, shape (T, M, 3); NaN where missing.
    """
    weights: Array
    """Final weights, including robust factors, shape (T, M); 0 where missing."""
    converged: NDArray[np.bool_]
    """Whether the iteration converged, shape (T,)."""
    underdetermined: NDArray[np.bool_]
    """Whether the markers do not determine a degree of freedom, shape (T,)."""
    iterations: NDArray[np.intp]
    """Number of iterations, shape (T,)."""


def solve_frames(
    model: ChainModel,
    markers: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    start: ChainState | None = None,
    options: IkOptions | None = None,
) -> IkResult:
    """Return the poses that minimize the weighted marker errors.

    Parameters
    ----------
    model
        Chain of S segments and M markers.
    markers : array_like, shape (T, M, 3)
        Measured positions in the world, m, in the order of ``model.markers``; NaN where missing.
    weights : array_like, shape (M,) or (T, M), optional
        Weights of squared errors; the weights of the model by default.
    start
        Initial state at T instants; computed from the markers by default.
    options
        Options of the solver; `IkOptions()` by default.

    Raises
    ------
    ValueError
        Shapes are inconsistent or weights are negative.
    """
    options = options or IkOptions()
    measured, seen = checked_markers(model, markers)
    w = checked_weights(model, weights, seen)
    if start is not None and len(start) != len(measured):
        raise ValueError(f"start has {len(start)} instants, the markers {len(measured)}")

    slots = marker_slots(model)
    problem = PoseProblem(
        model,
        slots.vectors_to_slots(measured),
        slots.to_slots(w),
        tolerance=options.tolerance,
        iterations=options.iterations,
        huber_m=options.huber_m,
        reweightings=options.reweightings,
        bands=limits_of(model, options.limit_m2),
    )

    if start is None:
        start, guessed = start_from_markers(model, problem.measured, problem.weights)
    else:
        guessed = np.zeros(len(measured), dtype=np.bool_)

    solution = _Solution.of(problem, start)
    size = max(_TOGETHER // model.nq, 1)
    for first in range(0, len(measured), size):
        solution.solve(np.arange(first, min(first + size, len(measured))))

    is_open = solution.is_open()
    solution.follow(guessed | is_open, is_open, options.hold_m2 * problem.typical_weight)
    return solution.result(seen, is_open)


@dataclass(frozen=True, slots=True)
class _Solution:
    """Solution in progress; its arrays are written in place."""

    problem: PoseProblem
    state: ChainState
    weights: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]

    @classmethod
    def of(cls, problem: PoseProblem, start: ChainState) -> _Solution:
        count = len(start)
        return cls(
            problem,
            start.copy(),
            problem.weights.copy(),
            np.zeros(count, dtype=np.bool_),
            np.zeros(count, dtype=np.intp),
        )

    def solve(self, instants: NDArray[np.intp], hold: Band | None = None) -> None:
        """Solve some instants from their current state."""
        part = self.problem.take(instants, hold)
        found = find_poses(part, self.state.take(instants))
        self.state.put(instants, found.state)
        self.weights[instants] = found.weights
        self.converged[instants] = found.converged
        self.iterations[instants] += found.iterations

    def is_open(self) -> NDArray[np.bool_]:
        """Return the instants at which the markers do not determine a degree of freedom.

        At these instants a Cholesky pivot of the normal matrix is small. A pivot is the information
        about one degree of freedom while all later degrees of freedom are free.
        """
        slots = marker_slots(self.problem.model)
        at = marker_fit(slots, self.state, self.problem.measured, self.weights)
        return open_instants(normal_equations(slots, at)[0] / self.problem.typical_weight)

    def follow(
        self, doubtful: NDArray[np.bool_], is_open: NDArray[np.bool_], hold_m2: float
    ) -> None:
        """Solve the undetermined instants again, each from the preceding instant.

        At the start of the trial, the following instant is used instead. Runs of undetermined
        instants are independent. The first instants of all runs are therefore solved together, then
        the second instants, and so on.
        """
        for instants, before in _waves(doubtful):
            last = self.state.take(before)
            self.state.put(instants, last)
            held: Array = hold_m2 * is_open[instants].astype(np.float64)
            hold = Band.holding(self.problem.model, last, held)
            self.solve(instants, hold)

    def result(self, seen: NDArray[np.bool_], is_open: NDArray[np.bool_]) -> IkResult:
        slots = marker_slots(self.problem.model)
        at = marker_fit(slots, self.state, self.problem.measured, self.weights)
        residuals = slots.from_slots(at.errors)
        residuals[~seen] = np.nan

        return IkResult(
            self.state,
            at.world[..., :3, :3],
            at.world[..., :3, 3],
            residuals,
            self.weights.reshape(len(seen), -1)[:, slots.places],
            self.converged,
            is_open,
            self.iterations,
        )


def open_instants(H: Array) -> NDArray[np.bool_]:
    """Return the instants at which the normal matrix, (T, nq, nq), is undetermined."""
    ridge = 1e-9 * np.eye(H.shape[-1])
    pivots = np.diagonal(np.linalg.cholesky(H + ridge), axis1=-2, axis2=-1)
    return np.asarray((pivots**2 < OPEN_M2).any(axis=-1))


def _waves(doubtful: NDArray[np.bool_]) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return groups of instants to solve together, with the instants from which they start."""
    good = np.flatnonzero(~doubtful)
    bad = np.flatnonzero(doubtful)
    if not good.size:
        return [(bad[i : i + 1], bad[i - 1 : i]) for i in range(1, len(bad))]
    last = np.searchsorted(good, bad) - 1
    leading = last < 0
    distance = np.where(leading, good[0] - bad, bad - good[last])
    before = np.where(leading, bad + 1, bad - 1)
    return [(bad[at], before[at]) for d in np.unique(distance) if (at := distance == d).any()]


def checked_markers(model: ChainModel, markers: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Return measured markers with zeros for NaN, and their presence, shape (T, M)."""
    measured = np.asarray(markers, dtype=np.float64)
    if measured.ndim != 3 or measured.shape[1:] != (len(model.markers), 3):
        raise ValueError(
            f"markers have shape {measured.shape}, expected (instants, {len(model.markers)}, 3)"
        )
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(measured).all(axis=-1))
    return np.where(seen[..., None], measured, 0.0), seen


def checked_weights(model: ChainModel, weights: ArrayLike | None, seen: NDArray[np.bool_]) -> Array:
    """Return weights, shape (T, M), zero where markers are missing."""
    w = model.weights if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape not in {seen.shape, seen.shape[1:]}:
        raise ValueError(f"weights have shape {w.shape}, expected {seen.shape[1:]} or {seen.shape}")
    if not (np.isfinite(w) & (w >= 0.0)).all():
        raise ValueError("weights must be finite and not negative")
    return np.where(seen, w, 0.0)


def tracking_error(residuals: Array) -> float:
    """Return the RMS length, m, of residuals (..., 3) of present markers; NaN if there are none."""
    square = np.einsum("...i,...i->...", residuals, residuals)
    seen = np.isfinite(square)
    return float(np.sqrt(square[seen].mean())) if seen.any() else float("nan")
