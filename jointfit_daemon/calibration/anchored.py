r"""The recommended model: a soft-tissue correction that turns with the subject.

.. math:: \hat q = f_0 \otimes \exp(\eta\, \mathrm{clip}(C^T \varphi))

f0 is the weighted mean of the segment's sensors, phi the relative rotations of `joint_features`, C
a robust ridge fit of :math:`\rho = \log(f_0^* \otimes q_{ref})`.

Law: zero correction in the static pose; exactly equivariant under turns of the world; outside the
hull of the training movements the correction fades (eta) instead of growing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.calibration.joint_features import features, features_one
from jointfit_daemon.calibration.robust_ridge import best_penalty, fit_ridge
from jointfit_daemon.calibration.segment_model import (
    Prediction,
    SegmentModel,
    SegmentTraining,
    widened,
)
from jointfit_daemon.calibration.weighted_mean import fuse, fuse_one, fusion_weights
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import exp_one, multiply_one

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

LARGEST = 0.4
"""No component of a correction exceeds this, rad."""
HULL = 10.0
"""The correction fades where the leverage exceeds this many times the training's 0.995 quantile."""
OUTSIDE = 3.0
"""And the frame is called extrapolating where it exceeds this many times."""


@dataclass(frozen=True)
class AnchoredModel(SegmentModel):
    """Weighted mean and its correction by relative rotations."""

    kind: ClassVar[str] = "anchored"

    weights: tuple[float, ...]
    """One a sensor, sum 1."""
    coefficients: tuple[tuple[float, ...], ...]
    """C^T: three rows, rad per unit of each feature."""
    leverage: tuple[tuple[float, ...], ...]
    """Square: ``phi @ leverage @ phi`` tells how far a frame lies outside training."""
    scales: tuple[float, ...]
    """RMS of each feature in training; what a recursive fit goes on with."""
    hull_leverage: float
    """0.995 quantile of the leverage over training."""
    mean_leverage: float
    ratio_offset: float
    """Mean over held-out frames of leverage ratio + 3: makes the mean claimed variance right."""
    covariance: tuple[tuple[float, ...], ...]
    """Mean outer product of held-out residuals, rad^2, 3x3, segment axes."""
    residual_sd: float
    mean_sd: float
    """Of the uncorrected mean on the training frames, rad per axis: when the neighbour is lost."""
    penalty: float
    movements: int
    """Kinds of movement in training."""
    _arrays: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Keep the tables as arrays beside: the frame loop multiplies by them."""
        arrays = (np.array(self.coefficients), np.array(self.leverage))
        object.__setattr__(self, "_arrays", arrays)

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the corrected mean, shape (n, 4); the plain mean without a neighbour."""
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
        """Return the corrected mean of one frame, its standard deviation by its leverage."""
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
        return widened(self.residual_sd * sqrt(grown), self.movements)

    @override
    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "kind": self.kind,
            "weights": list(self.weights),
            "coefficients": [list(row) for row in self.coefficients],
            "leverage": [list(row) for row in self.leverage],
            "scales": list(self.scales),
            "hull_leverage": self.hull_leverage,
            "mean_leverage": self.mean_leverage,
            "ratio_offset": self.ratio_offset,
            "covariance": [list(row) for row in self.covariance],
            "residual_sd": self.residual_sd,
            "mean_sd": self.mean_sd,
            "penalty": self.penalty,
            "movements": self.movements,
        }

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> AnchoredModel:
        """Return the model of its JSON form."""
        return cls(
            weights=tuple(data["weights"]),
            coefficients=_tuples(data["coefficients"]),
            leverage=_tuples(data["leverage"]),
            scales=tuple(data["scales"]),
            hull_leverage=data["hull_leverage"],
            mean_leverage=data["mean_leverage"],
            ratio_offset=data["ratio_offset"],
            covariance=_tuples(data["covariance"]),
            residual_sd=data["residual_sd"],
            mean_sd=data["mean_sd"],
            penalty=data["penalty"],
            movements=data["movements"],
        )


def fit_anchored(training: SegmentTraining) -> AnchoredModel:
    """Fit the correction; its penalty and its claimed variance come from held-out blocks.

    Raises
    ------
    ValueError
        There is no neighbouring segment to look at.
    """
    if training.q_other is None:
        raise ValueError("the anchored model needs a sensor of the neighbouring segment")
    weights = fusion_weights(training.sensors, training.q_reference)
    mean = fuse(training.sensors, weights.tolist())
    rho = rotation.log(rotation.multiply(rotation.conjugate(mean), training.q_reference))
    phi = features(training.sensors, training.q_other)
    penalty, held = best_penalty(phi, rho, training.folds())
    ridge = fit_ridge(phi, rho, penalty)
    h = ridge.leverages(phi)
    covariance = held.residuals.T @ held.residuals / len(held.residuals)
    return AnchoredModel(
        weights=tuple(weights.tolist()),
        coefficients=_tuples(ridge.coefficients.T.tolist()),
        leverage=_tuples(ridge.leverage.tolist()),
        scales=tuple(ridge.scales.tolist()),
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
