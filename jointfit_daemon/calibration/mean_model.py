"""The model that trusts its sensors: their weighted mean, uncorrected. Law: needs no neighbour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.calibration.segment_model import (
    Prediction,
    SegmentModel,
    SegmentTraining,
    cross_validated_sd,
)
from jointfit_daemon.calibration.weighted_mean import fuse, fuse_one, fusion_weights
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion


@dataclass(frozen=True)
class MeanModel(SegmentModel):
    """Weighted mean of the sensors."""

    kind: ClassVar[str] = "mean"

    weights: tuple[float, ...]
    """One a sensor, sum 1."""
    residual_sd: float

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the weighted mean, shape (n, 4); see `SegmentModel.predict`."""
        return fuse([np.asarray(q, dtype=np.float64) for q in sensors], self.weights)

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the weighted mean of one frame."""
        return Prediction(fuse_one(sensors, self.weights), self.residual_sd, False)

    @override
    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "kind": self.kind,
            "weights": list(self.weights),
            "residual_sd": self.residual_sd,
        }

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> MeanModel:
        """Return the model of its JSON form."""
        return cls(tuple(data["weights"]), data["residual_sd"])


def plain_mean(training: SegmentTraining) -> MeanModel:
    """Return the mean with equal weights: the baseline that learns nothing but its own error."""
    weights = (1.0 / len(training.sensors),) * len(training.sensors)
    said = fuse(training.sensors, weights)
    angles = rotation.angle_between(said, training.q_reference)
    return MeanModel(weights, float(np.sqrt(np.mean(angles**2) / 3.0)))


def best_single(training: SegmentTraining) -> MeanModel:
    """Return the sensor that is nearest to the reference in training, alone: weight 1, others 0."""

    def best(part: SegmentTraining) -> int:
        errors = [rotation.angle_between(q, part.q_reference) for q in part.sensors]
        return int(np.argmin([np.mean(error**2) for error in errors]))

    def fit(part: SegmentTraining) -> Callable[[SegmentTraining], Array]:
        chosen = best(part)
        return lambda test: test.sensors[chosen]

    chosen = best(training)
    weights = tuple(float(k == chosen) for k in range(len(training.sensors)))
    return MeanModel(weights, cross_validated_sd(training, fit))


def fit_mean(training: SegmentTraining) -> MeanModel:
    """Return the mean weighted by each sensor's own error against the reference."""

    def fit(part: SegmentTraining) -> Callable[[SegmentTraining], Array]:
        weights = tuple(fusion_weights(part.sensors, part.q_reference).tolist())
        return lambda test: fuse(test.sensors, weights)

    weights = tuple(fusion_weights(training.sensors, training.q_reference).tolist())
    return MeanModel(weights, cross_validated_sd(training, fit))
