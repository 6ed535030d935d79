"""Fine fit of the lag, simultaneous with rotation and bias, on three axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics.rotation_scalar import exp_one, to_matrix_one
from jointfit_daemon.timing.lag._angular_rates import KERNEL_HALF_S, Interpolant
from jointfit_daemon.timing.lag._standard_deviation import RIDGE, LinearizedLag, lag_sigma

if TYPE_CHECKING:
    from collections.abc import Generator

    from jointfit_daemon.timing.lag._angular_rates import Floats, Rates

HUBERS = (1.5, 2.4, np.inf)
"""Candidate Huber thresholds for the norm of the three residual components, in standard deviations
per axis (the median norm is 1.538). A low threshold suits bursts of optical errors. A high
threshold suits errors that grow with the motion, where the largest residuals contain the most
information.
"""
CHOICES = 6
"""Number of initial iterations, each of which selects the threshold with the least lag variance.
The later iterations use the last selected threshold."""
MEDIAN_NORM = 1.538
"""Median norm of a standard normal vector of three components."""
STEP_S = 0.020
"""Largest change of the lag per iteration, s."""
ITERATIONS = 30
"""Largest number of iterations."""
DONE_S = 1e-6
"""Change of the lag, s. The fit has converged if two successive changes are smaller. The rotation
is not checked, because it may change about a single axis of motion without effect on the lag.
"""
LEAST_PAIRS = 16
"""Least number of compared rates."""

_FIRST_HUBER = 2.4
_TINY = 1e-12
_BY_BIAS = -np.eye(3)
"""Derivative of a residual with respect to the bias."""


@dataclass(frozen=True, slots=True)
class LagFit:
    """Result of the fit, with the sign convention of ``LagEstimate``."""

    tau_s: float
    sigma_s: float
    rotation: Floats
    """Rotation R from reference-body to IMU coordinates, shape (3, 3)."""
    bias: Floats
    """Bias of the IMU's rate, rad/s, shape (3,)."""
    r2: float
    residual_rms: float
    mean_weight: float
    """Mean Huber weight at the threshold 2.4, even if the fit used another threshold."""
    pairs: int
    converged: bool


class _State(NamedTuple):
    tau: float
    rot: Floats
    bias: Floats


def fit_lag(
    imu: Rates, ref: Rates, start_s: float, stamp_sd_s: float = 0.0
) -> Generator[None, None, LagFit | None]:
    r"""Fit :math:`r_j = g(t_j + \tau) - b - R\omega_j` over (R, b, tau).

    The symbols are defined in ``_estimate``. The method is a Gauss-Newton iteration over all seven
    unknowns, with Huber weights on |r|. The Huber threshold with the smallest variance of the lag
    is selected. The track with the higher sample rate is interpolated at the instants of the other
    track.

    Parameters
    ----------
    imu, ref : Rates
        Low-pass filtered with the same kernel.
    start_s : float
        Coarse lag, s.
    stamp_sd_s : float
        Standard deviation of the slowly varying error of the timestamps, s.

    Yields
    ------
    None
        After every iteration, which takes about a millisecond.

    Returns
    -------
    LagFit or None
        Fit; None if the overlap of the tracks is too short.
    """
    # The faster track is interpolated. If the reference is faster, g and omega are exchanged.
    swapped = imu.period_s > ref.period_s
    fast, slow = (ref, imu) if swapped else (imu, ref)
    cubic = Interpolant(fast)
    state = _start(cubic, slow, -start_s if swapped else start_s)
    if state is None:
        return None

    converged, before = False, float("inf")
    clip: float | None = None
    for iteration in range(ITERATIONS):
        linear = _linearize(cubic, slow, state, clip)
        if linear is None:
            return None
        if iteration < CHOICES:
            clip = _best_clip(linear)
        state, moved = _step(linear, state)
        if max(moved, before) < DONE_S:
            converged = True
            break
        before = moved
        yield

    linear = _linearize(cubic, slow, state, clip)
    if linear is None:
        return None
    yield

    # The exchanged problem is omega = R^T g - R^T b.
    rot, bias = (state.rot.T, -state.rot.T @ state.bias) if swapped else (state.rot, state.bias)
    norm = np.linalg.norm(linear.residual, axis=1)
    square = float(norm @ norm)
    return LagFit(
        tau_s=-state.tau if swapped else state.tau,
        sigma_s=lag_sigma(linear, 2.0 * KERNEL_HALF_S, stamp_sd_s),
        rotation=rot,
        bias=bias,
        r2=1.0 - square / max(float(np.sum(linear.rate**2)), _TINY),
        residual_rms=float(np.sqrt(square / linear.residual.size)),
        mean_weight=float(_huber_weights(norm, _FIRST_HUBER * _scale(norm)).mean()),
        pairs=len(linear.residual),
        converged=converged,
    )


def _start(cubic: Interpolant, slow: Rates, tau: float) -> _State | None:
    """Return the initial state: zero bias, and the rotation from an SVD of the covariance."""
    g, _, ok = cubic(slow.t_s + tau)
    if ok.sum() < LEAST_PAIRS:
        return None
    g, omega = g[ok] - g[ok].mean(axis=0), slow.w[ok] - slow.w[ok].mean(axis=0)
    u, _, vt = np.linalg.svd(g.T @ omega)
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    return _State(tau, u @ vt, np.zeros(3))


def _linearize(
    cubic: Interpolant, slow: Rates, state: _State, clip: float | None
) -> LinearizedLag | None:
    """Return the problem linearized at a state; None if the overlap of the tracks is too short."""
    g, slope, ok = cubic(slow.t_s + state.tau)
    if ok.sum() < LEAST_PAIRS:
        return None
    omega, t_s = slow.w, slow.t_s
    if not ok.all():
        g, slope, omega, t_s = g[ok], slope[ok], omega[ok], t_s[ok]
    turned = omega @ state.rot.T
    r = g - state.bias - turned
    norm = _norms(r)
    weight = _huber_weights(norm, _FIRST_HUBER * _scale(norm) if clip is None else clip)

    # Derivatives with respect to rotation (the matrix of the cross product), bias and lag.
    x, y, z = turned.T
    jacobian = np.zeros((len(r), 3, 7))
    jacobian[:, 0, 2], jacobian[:, 1, 0], jacobian[:, 2, 1] = y, z, x
    np.negative(z, out=jacobian[:, 0, 1])
    np.negative(x, out=jacobian[:, 1, 2])
    np.negative(y, out=jacobian[:, 2, 0])
    jacobian[:, :, 3:6] = _BY_BIAS
    jacobian[:, :, 6] = slope
    return LinearizedLag(jacobian, r, weight, (weight < 1.0).astype(np.float64), omega, t_s)


def _norms(vectors: Floats) -> Floats:
    x, y, z = vectors.T  # columns are faster than a sum over an axis of three elements
    norms: Floats = np.sqrt(x * x + y * y + z * z)
    return norms


def _scale(norm: Floats) -> float:
    """Return the robust standard deviation per axis of residuals, from their norms."""
    # This median is valid for finite values only, and takes half the time of ``np.median``.
    middle = norm.size // 2
    if norm.size % 2:
        median = float(np.partition(norm, middle)[middle])
    else:
        ordered = np.partition(norm, (middle - 1, middle))
        median = 0.5 * float(ordered[middle - 1] + ordered[middle])
    return max(median, _TINY) / MEDIAN_NORM


def _huber_weights(norm: Floats, clip: float) -> Floats:
    """Return the Huber weight of each norm, with the threshold `clip`."""
    return np.minimum(1.0, clip / np.maximum(norm, _TINY))


def _best_clip(linear: LinearizedLag) -> float:
    r"""Return the threshold, rad/s, with the least variance :math:`\sum h\psi^2 / (\sum h\psi')^2`.

    h is the information about the lag in one compared rate, and psi the derivative of the Huber
    loss. Correlations between residuals are neglected, because they are the same for all
    thresholds.
    """
    norm = _norms(linear.residual)
    scale = _scale(norm)
    x, y, z = linear.jacobian[:, :, 6].T
    information = x * x + y * y + z * z

    def variance(clip: float) -> float:
        weight = _huber_weights(norm, clip)
        curve = weight * np.where(weight < 1.0, 2.0 / 3.0, 1.0)
        spread = float(information @ (weight * norm) ** 2)
        return spread / float(information @ curve + _TINY) ** 2

    return min((huber * scale for huber in HUBERS), key=variance)


def _step(linear: LinearizedLag, state: _State) -> tuple[_State, float]:
    """Return the next state and the change of the lag, s."""
    rows = linear.jacobian.reshape(-1, 7)
    weighted = (linear.jacobian * linear.weight[:, None, None]).reshape(-1, 7).T
    normal = weighted @ rows
    gradient = weighted @ linear.residual.reshape(-1)

    ridge = RIDGE * max(normal[0, 0] + normal[1, 1] + normal[2, 2], _TINY)
    for axis in range(3):
        normal[axis, axis] += ridge
    normal[6, 6] += _TINY

    move = -np.linalg.solve(normal, gradient)
    tau = float(min(max(move[6], -STEP_S), STEP_S))
    x, y, z, *_ = move.tolist()
    rot = np.array(to_matrix_one(exp_one((x, y, z)))) @ state.rot
    return _State(state.tau + tau, rot, state.bias + move[3:6]), abs(tau)
