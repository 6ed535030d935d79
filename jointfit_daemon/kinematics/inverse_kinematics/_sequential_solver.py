r"""Sequential inverse kinematics for one instant at a time, with the covariance of each pose.

The solver extrapolates the last pose to the next instant, and takes one or a few safeguarded
Gauss-Newton steps. If the marker errors remain large, the solver restarts from the markers alone
(`start_from_markers`). The covariance of a pose, in the columns of a step, is

.. math:: \Sigma = \sigma^2 \left(\sum_m w_m J_m^T J_m\right)^{-1}

where :math:`\sigma` is the marker error per axis, which is configured or estimated from the
residuals. J is the Jacobian and w the weight of marker m. Degrees of freedom that the markers do
not determine keep their last values. Their variance in :math:`\Sigma` is large, but finite.

Invariant: the marker errors are evaluated at most `MOST_EVALUATIONS` times per instant, for every
input.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import lapack

from jointfit_daemon.kinematics.chains import ChainState, rest_state, step_state
from jointfit_daemon.kinematics.inverse_kinematics._initial_pose import start_from_markers
from jointfit_daemon.kinematics.inverse_kinematics._levenberg_marquardt import Band
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import (
    MarkerFit,
    lower_equations,
    marker_fit,
    marker_slots,
)
from jointfit_daemon.kinematics.inverse_kinematics._solver import OPEN_M2

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel

MOST_EVALUATIONS = 16
"""Largest number of evaluations of the marker errors in one instant."""
_MOST_FOLLOWING = 8
"""Largest number of evaluations in an instant without a restart. A search that reaches this number
continues in the next instant."""
_TRIES = 6
"""Largest number of attempts of a step; each attempt has more damping."""
_RESTART_STEPS = 10
"""Largest number of steps after a restart."""
_LAST_STEP = 3e-3
"""Step below which the remaining error is negligible, rad and m."""
_DAMPING = 1e-2
_RIDGE = 1e-9
_ROUNDING = 1e-9
_OPEN_SLACK = 1e-2
"""Accepted relative increase of the marker cost in a regularized step, because the regularization
may increase this cost.
"""
_FORGETTING = 0.02
_FIRST_SD_M = 0.003
_FIRST_INSTANTS = 5
"""Weight of the initial standard deviation in the estimate of the marker error, as a number of
instants.
"""
_MOST_PATIENCE = 32
"""Largest number of restart intervals between two restarts of a chain that does not fit its
markers.
"""
_STRAIGHTEN = 32
"""Number of instants between two re-orthonormalizations of the rotations."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Options of the sequential solver; the defaults are for skin-mounted markers at 100 Hz."""

    steps: int = 2
    """Largest number of steps per instant. At 100 Hz the cost is within 0.1 % of the minimum after
    two steps.
    """
    huber_m: float | None = None
    """Huber threshold c of the marker error, m. Errors e above c have the weight c/|e|. None is a
    least-squares fit.
    """
    hold_m2: float = 1e-4
    """Weight of the pose at the last instant for joints that the markers do not determine,
    m^2/rad^2.
    """
    marker_sd_m: float | None = None
    """Marker error per axis, m. If None, the solver estimates it from the residuals, with a time
    constant of 50 instants.
    """
    lost_m: float = 0.06
    """Weighted RMS marker error, m, above which the solver restarts from the markers alone."""
    restart_interval: int = 1
    """Smallest number of instants between two restarts, which take much longer than a step."""


@dataclass(frozen=True, slots=True)
class LivePose:
    """Pose of a chain at one instant."""

    state: ChainState
    """State of the chain at this instant."""
    rotations: Array
    """R_world_segment, shape (S, 3, 3)."""
    origins: Array
    """Origins of the segments in the world, m, shape (S, 3)."""
    residuals: Array
    """Marker position of the model minus measured position, m, shape (M, 3); NaN where missing."""
    covariance: Array
    """Covariance of the step from the true state to the estimate, rad^2 and m^2, shape (nq, nq)."""
    determined: NDArray[np.bool_]
    """Mask of the degrees of freedom that the markers determine, shape (nq,). The information about
    each of them, while all others are free, is at least the information of one marker that is 2 cm
    from the axis of the degree of freedom.
    """
    underdetermined: bool
    """Whether the markers do not determine a degree of freedom, which then keeps its last value."""
    restarted: bool
    """Whether the solver restarted from the markers instead of the last pose."""
    evaluations: int
    """Number of evaluations of the marker errors."""


class LiveInverseKinematics:
    """Sequential inverse kinematics of a chain.

    Parameters
    ----------
    model
        The chain.
    options
        Options of the solver; `LiveOptions()` by default.
    """

    def __init__(self, model: ChainModel, options: LiveOptions | None = None) -> None:
        self._model = model
        self._options = options or LiveOptions()
        self._slots = marker_slots(model)
        self._state: ChainState | None = None
        self._variance = (self._options.marker_sd_m or _FIRST_SD_M) ** 2
        weighing = model.weights[model.weights > 0.0]
        self._typical = float(np.median(weighing)) if weighing.size else 1.0
        self._fed = 0
        self._restarted_at = 0
        self._patience = 1
        """Number of restart intervals to wait. It is doubled by every restart after which the chain
        still does not fit its markers.
        """
        self._learned = 0
        self._still = np.zeros(model.nq)
        self._lead = self._still
        self._identity = np.eye(model.nq)
        self._evaluations = 0

    def feed(self, markers: ArrayLike) -> LivePose:
        """Return the pose of the next instant.

        Parameters
        ----------
        markers : array_like, shape (M, 3)
            Measured marker positions in the world, in the order of the model, m; NaN where missing.

        Raises
        ------
        ValueError
            The array has another shape.
        """
        given = np.asarray(markers, dtype=np.float64)
        if given.shape != (len(self._model.markers), 3):
            raise ValueError(
                f"markers have shape {given.shape}, expected ({len(self._model.markers)}, 3)"
            )
        seen: NDArray[np.bool_] = np.asarray(np.isfinite(given).all(axis=-1))
        measured = self._slots.vectors_to_slots(np.where(seen[:, None], given, 0.0)[None])
        weights = self._slots.to_slots((self._model.weights * seen)[None])
        self._fed += 1
        self._evaluations = 0
        place, restarted = self._solve(measured, weights)
        self._lead = self._still if place.is_open or restarted else place.moved
        self._state = place.state
        if self._fed % _STRAIGHTEN == 0:
            # Make the rotations orthonormal by one Newton step towards A^T A = 1.
            A = place.state.rotations
            turned = 1.5 * A - 0.5 * (A @ (A.swapaxes(-1, -2) @ A))
            self._state = replace(place.state, rotations=turned)
        return self._pose(place, seen, restarted=restarted)

    def _solve(self, measured: Array, weights: Array) -> tuple[_Place, bool]:
        """Return the state of the chain and whether it was restarted from the markers alone."""
        if self._state is None:
            return self._restart(measured, weights), True

        steps = max(self._options.steps, 1)
        place = self._follow(self._state, self._lead, measured, weights, (steps, _MOST_FOLLOWING))
        if not self._is_lost(place):
            self._patience = 1
            return place, False
        if self._fed - self._restarted_at < self._patience * self._options.restart_interval:
            return place, False

        self._restarted_at = self._fed
        again = self._restart(measured, weights)
        self._patience = min(2 * self._patience, _MOST_PATIENCE) if self._is_lost(again) else 1
        return (again, True) if again.cost < place.cost else (place, False)

    def _restart(self, measured: Array, weights: Array) -> _Place:
        """Return the state of an instant from its markers alone."""
        start = rest_state(self._model)
        if weights.any():
            start = start_from_markers(self._model, measured, weights)[0]
        limits = (_RESTART_STEPS, MOST_EVALUATIONS)
        return self._follow(start, self._still, measured, weights, limits)

    def _is_lost(self, place: _Place) -> bool:
        return place.cost > float(place.at.weighted[..., 3, :].sum()) * self._options.lost_m**2

    def _follow(
        self,
        last: ChainState,
        lead: Array,
        measured: Array,
        weights: Array,
        limits: tuple[int, int],
    ) -> _Place:
        """Take the steps of one instant, starting from the last state moved by the step `lead`.

        `limits` are the largest numbers of steps and of evaluations in the instant. The returned
        Cholesky factor was computed at the start of the last step. Its difference from the factor
        at the final state is negligible in a covariance.
        """
        steps, most = limits
        place, w = self._move(last, lead, measured, weights), weights
        travelled, equations = lead, None
        for _ in range(steps):
            robust = self._robust(place.at, weights)
            if robust is not w:
                at, w = place.at.with_weights(robust), robust
                place = _Place(place.state, at, float(at.cost[0]))
            equations = self._equations(place, last)
            tries = min(_TRIES, most - self._evaluations)
            step, place = self._one_step(place, equations, measured, w, tries)
            travelled = travelled + step
            is_last = self._evaluations >= most
            if is_last or max(float(step.max()), -float(step.min())) < _LAST_STEP:
                break
        return _Place(place.state, place.at, place.cost, travelled, equations)

    def _move(self, state: ChainState, step: Array, measured: Array, weights: Array) -> _Place:
        self._evaluations += 1
        state = step_state(self._slots.layout, state, step[None])
        at = marker_fit(self._slots, state, measured, weights)
        return _Place(state, at, float(at.cost[0]))

    def _robust(self, at: MarkerFit, weights: Array) -> Array:
        """Return the robust weights, which equal `weights` if no error exceeds the threshold."""
        limit = self._options.huber_m
        if limit is None:
            return weights
        errors = at.errors
        square = np.einsum("tsik,tsik->tsk", errors, errors)
        # errors of missing markers are meaningless and often large
        square *= weights > 0.0
        if square.max() <= (limit - _ROUNDING) ** 2:
            return weights
        return np.asarray(weights * np.minimum(1.0, limit / (np.sqrt(square) + 1e-12)))

    def _equations(self, place: _Place, reference: ChainState) -> _Equations:
        """Return the normal equations at a state.

        They are regularized toward `reference` if the markers do not determine a degree of freedom.
        """
        lower, gradient = lower_equations(self._slots, place.at)
        H, g = lower[0], gradient[0]
        diagonal = H.ravel()[:: len(g) + 1]
        diagonal += _RIDGE
        factor, failed = lapack.dpotrf(H, lower=1)
        is_open = failed != 0 or float(factor.diagonal().min()) ** 2 < OPEN_M2 * self._typical
        if is_open:
            weight = self._options.hold_m2 * self._typical
            hold = Band(reference, np.full((1, len(g)), weight), _ZERO, _ZERO)
            g = g + weight * hold.excess(self._slots.layout, place.state)[0]
            diagonal += weight
            factor, _ = lapack.dpotrf(H, lower=1)
        return _Equations(H, g, factor, is_open)

    def _one_step(
        self, place: _Place, equations: _Equations, measured: Array, weights: Array, tries: int
    ) -> tuple[Array, _Place]:
        """Return a step that does not raise the cost beyond a tolerance, and the state after it.

        The step is zero if every tried step raises the cost.
        """
        factor, damping = equations.factor, 0.0
        most = place.cost * (1.0 + (_OPEN_SLACK if equations.is_open else _ROUNDING))
        for _ in range(tries):
            step = lapack.dpotrs(factor, -equations.g, lower=1)[0]
            there = self._move(place.state, step, measured, weights)
            if there.cost <= most:
                return step, there
            damping = max(_DAMPING, 10.0 * damping)
            damped = equations.H + damping * np.diag(equations.H.diagonal())
            factor, _ = lapack.dpotrf(damped, lower=1)
        return self._still, place

    def _pose(self, place: _Place, seen: NDArray[np.bool_], *, restarted: bool) -> LivePose:
        residuals = self._slots.from_slots(place.at.errors)[0]
        residuals[~seen] = np.nan
        self._learn(place.cost, int(seen.sum()))
        # dpotrs is used because dpotri starts threads even for small matrices
        inverse = lapack.dpotrs(place.factor, self._identity, lower=1)[0]
        determined = inverse.diagonal() * OPEN_M2 * self._typical <= 1.0
        covariance = self._variance * inverse
        return LivePose(
            place.state,
            place.at.world[0, :, :3, :3],
            place.at.world[0, :, :3, 3],
            residuals,
            covariance,
            determined,
            place.is_open,
            restarted,
            self._evaluations,
        )

    def _learn(self, cost: float, seen: int) -> None:
        freedom = 3 * seen - self._model.nq
        if self._options.marker_sd_m is None and freedom > 0:
            self._learned += 1
            gain = max(_FORGETTING, 1.0 / (self._learned + _FIRST_INSTANTS))
            self._variance += gain * (cost / freedom - self._variance)


_ZERO = np.zeros(1)


class _Equations(NamedTuple):
    """Normal equations of one step."""

    H: Array
    """Lower triangle of H, shape (nq, nq)."""
    g: Array
    factor: Array
    """Lower Cholesky factor of H."""
    is_open: bool


@dataclass(frozen=True, slots=True)
class _Place:
    """State during the solution of one instant."""

    state: ChainState
    at: MarkerFit
    cost: float
    moved: Array = field(default_factory=lambda: _ZERO)
    """Step from the state at the last instant to this state."""
    equations: _Equations | None = None
    """Normal equations of the last step; None before the first step."""

    @property
    def factor(self) -> Array:
        """Lower Cholesky factor of the normal matrix; identity before the first step."""
        return np.eye(len(self.moved)) if self.equations is None else self.equations.factor

    @property
    def is_open(self) -> bool:
        return self.equations is None or self.equations.is_open
