# ruff: noqa: N806 - matrices have capital names
r"""Baseline: a linear soft-tissue correction of the weighted mean, without kernels.

.. math:: \hat q = f_0 \otimes \exp(\eta\, \mathrm{clip}(C^T \varphi))

Here :math:`f_0` is the weighted mean of the sensors of a segment, and :math:`\varphi` are the
regressors from `features`. C is a robust ridge fit of :math:`\rho = \log(f_0^* \otimes q_{ref})`,
where :math:`q_{ref}` is the reference. The factor :math:`\eta` is 1 in and near the training
range, and decreases far outside it (`HULL`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sin, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.calibration.soft_tissue import fit_ridge, fusion_weights
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import (
    between_one,
    exp_one,
    log_one,
    multiply_one,
)
from jointfit_daemon.limb_model import Prediction, SegmentModel, fuse, fuse_one, widen_sd

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.soft_tissue import SegmentTraining
    from jointfit_daemon.model import Quaternion

PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge penalties that are compared on held-out blocks."""
LARGEST = 0.4
"""Largest component of a correction, rad."""
HULL = 10.0
"""The correction fades if the leverage of a frame exceeds this multiple of the 0.995 quantile of
the training leverages."""
OUTSIDE = 3.0
"""A frame has the flag ``extrapolating`` if its leverage exceeds this multiple of the same
quantile."""


@dataclass(frozen=True)
class LinearCorrection(SegmentModel):
    """Weighted mean of the sensors, corrected by relative rotations."""

    kind: ClassVar[str] = "linear"

    weights: tuple[float, ...]
    """One weight per sensor; the sum is 1."""
    coefficients: tuple[tuple[float, ...], ...]
    """Matrix C^T with three rows, rad per unit of each feature."""
    leverage: tuple[tuple[float, ...], ...]
    """Square matrix L. The leverage ``phi @ L @ phi`` is the distance of a frame from the training
    range."""
    hull_leverage: float
    """0.995 quantile of the leverage in training."""
    mean_leverage: float
    ratio_offset: float
    """Mean of r + 3 over the held-out frames, where r is the leverage of a frame divided by the
    mean training leverage. The predicted variance of a frame is proportional to (r + 3) divided by
    this mean, so the mean predicted variance is unbiased.
    """
    covariance: tuple[tuple[float, ...], ...]
    """Mean outer product of held-out residuals, rad^2, 3x3, segment axes."""
    residual_sd: float
    mean_sd: float
    """RMS error of the uncorrected mean in training, rad per axis. It is the predicted standard
    deviation of a frame without an orientation of the neighbouring segment."""
    penalty: float
    movements: int
    """Number of movements in training."""
    _arrays: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Store the tables as arrays for the loop over frames."""
        arrays = (np.array(self.coefficients), np.array(self.leverage))
        object.__setattr__(self, "_arrays", arrays)

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the corrected mean, shape (n, 4); the uncorrected mean if `q_other` is None."""
        inputs = [np.asarray(q, dtype=np.float64) for q in sensors]
        mean = fuse(inputs, self.weights)
        if q_other is None:
            return mean
        C, leverage = self._arrays
        phi = features(inputs, np.asarray(q_other, dtype=np.float64))
        ratio = np.einsum("ij,jk,ik->i", phi, leverage, phi) / self.hull_leverage
        fade = 1.0 / np.sqrt(np.maximum(ratio / HULL, 1.0))
        correction = np.clip(phi @ C.T, -LARGEST, LARGEST)
        return rotation.multiply(mean, rotation.exp(fade[:, None] * correction))

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the corrected mean of one frame and its standard deviation."""
        mean = fuse_one(sensors, self.weights)
        if q_other is None:
            return Prediction(mean, self.mean_sd, False)
        C, leverage = self._arrays
        phi = np.array(features_one(sensors, q_other))
        h = float(phi @ (leverage @ phi))
        ratio = h / self.hull_leverage
        fade = 1.0 if ratio <= HULL else sqrt(HULL / ratio)
        x, y, z = (C @ phi).tolist()
        turn = (fade * _clipped(x), fade * _clipped(y), fade * _clipped(z))
        return Prediction(multiply_one(mean, exp_one(turn)), self._sd(h), ratio > OUTSIDE)

    def _sd(self, h: float) -> float:
        grown = (h / self.mean_leverage + 3.0) / self.ratio_offset
        return widen_sd(self.residual_sd * sqrt(grown), self.movements)

    @override
    def to_dict(self) -> dict[str, Any]:
        """Raise an error, because a baseline is never stored."""
        raise NotImplementedError

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> LinearCorrection:
        """Raise an error, because a baseline is never stored."""
        raise NotImplementedError


def fit_linear_correction(training: SegmentTraining) -> LinearCorrection:
    """Fit the correction; determine penalty and predicted variance on held-out blocks.

    Raises
    ------
    ValueError
        `training` contains no neighbouring segment.
    """
    if training.q_other is None:
        raise ValueError("the linear correction needs a sensor of the neighbouring segment")
    weights = fusion_weights(training.sensors, training.q_reference)
    mean = fuse(training.sensors, weights.tolist())
    rho = rotation.log(rotation.multiply(rotation.conjugate(mean), training.q_reference))
    phi = features(training.sensors, training.q_other)
    penalty, held = best_penalty(phi, rho, training.folds())
    ridge = fit_ridge(phi, rho, penalty)
    h = ridge.leverages(phi)
    covariance = held.residuals.T @ held.residuals / len(held.residuals)
    return LinearCorrection(
        weights=tuple(weights.tolist()),
        coefficients=_tuples(ridge.coefficients.T.tolist()),
        leverage=_tuples(ridge.leverage.tolist()),
        hull_leverage=float(np.quantile(h, 0.995)),
        mean_leverage=float(np.mean(h)),
        ratio_offset=float(np.mean(held.leverage_ratios)) + 3.0,
        covariance=_tuples(covariance.tolist()),
        residual_sd=float(np.sqrt(np.trace(covariance) / 3.0)),
        mean_sd=float(np.sqrt(np.mean(np.sum(rho**2, axis=1)) / 3.0)),
        penalty=penalty,
        movements=training.movements,
    )


def _tuples(rows: Iterable[Iterable[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in rows)


def _clipped(value: float) -> float:
    return min(max(value, -LARGEST), LARGEST)


def features(sensors: Sequence[Array], q_other: Array) -> Array:
    r"""Return the regressors of a segment, shape (n, 12 + 3 (m - 1)) for m sensors.

    .. math:: \varphi = [k,\ d_2 \dots d_m,\ |k| \circ k,\ k_1 k_2,\ k_1 k_3,\ k_2 k_3,\ \sin 2k]

    Here :math:`k = \log(x^* \otimes o)` is the joint rotation between the first sensor x and the
    neighbour o. :math:`d_j = \log(x^* \otimes y_j)` is the rotation from the first sensor to
    sensor :math:`y_j`. k and :math:`d_j` are in rad. :math:`\circ` is the product of components.

    Parameters
    ----------
    sensors : sequence of ndarray, shape (n, 4)
        Orientations of the sensors of the segment, aligned to the bone.
    q_other : ndarray, shape (n, 4)
        Orientation of the neighbouring segment, from its sensors aligned to the bone.
    """
    inverse = rotation.conjugate(sensors[0])
    k = rotation.log(rotation.multiply(inverse, q_other))
    pairs = [rotation.log(rotation.multiply(inverse, q)) for q in sensors[1:]]
    products = k[:, [0, 0, 1]] * k[:, [1, 2, 2]]
    return np.concatenate([k, *pairs, np.abs(k) * k, products, np.sin(2.0 * k)], axis=1)


def features_one(sensors: Sequence[Quaternion], q_other: Quaternion) -> list[float]:
    """Return the regressors of one frame."""
    first = sensors[0]
    a, b, c = log_one(between_one(first, q_other))
    found = [a, b, c]
    for q in sensors[1:]:
        found += log_one(between_one(first, q))
    found += (abs(a) * a, abs(b) * b, abs(c) * c, a * b, a * c, b * c)
    found += (sin(2.0 * a), sin(2.0 * b), sin(2.0 * c))
    return found


@dataclass(frozen=True, slots=True)
class CrossValidated:
    """Errors of a fit on held-out blocks."""

    residuals: Array
    """rho minus prediction, rad, shape (n, 3)."""
    leverage_ratios: Array
    """Leverage of each held-out row divided by the mean leverage of its training rows, shape (n,).
    """

    @property
    def score(self) -> float:
        """Sum of the squared residuals."""
        return float(np.sum(self.residuals**2))


def cross_validate(
    phi: Array, rho: Array, penalty: float, folds: Iterable[NDArray[np.bool_]]
) -> CrossValidated:
    """Leave out each fold in turn, fit the rest, and evaluate on the fold."""
    residuals, ratios = [], []
    for held in folds:
        fit = fit_ridge(phi[~held], rho[~held], penalty)
        residuals.append(rho[held] - phi[held] @ fit.coefficients)
        ratios.append(fit.leverages(phi[held]) / np.mean(fit.leverages(phi[~held])))
    return CrossValidated(np.concatenate(residuals), np.concatenate(ratios))


def best_penalty(
    phi: Array, rho: Array, folds: Iterable[NDArray[np.bool_]]
) -> tuple[float, CrossValidated]:
    """Return the penalty with the smallest held-out score, and its errors."""
    blocks = list(folds)
    tried = [(penalty, cross_validate(phi, rho, penalty, blocks)) for penalty in PENALTIES]
    return min(tried, key=lambda pair: pair[1].score)
