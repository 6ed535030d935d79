r"""Baseline model: weighted mean of sensors, each aligned with the reference by constant rotations.

.. math:: \hat q = \operatorname{mean}_\omega \left( q_{W,m} \otimes q_m \otimes q_{B,m} \right)

The model has three constants for each sensor: the rotation of its world about the vertical, a
sensor-to-segment alignment and a weight. No term of the model depends on posture. The fitted
heading contains soft-tissue artefact that correlates with flexion. The model is therefore valid
only at the heading of the training movement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # in typing from Python 3.12 on

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion, multiply_one
from jointfit_daemon.limb_model._segment_model import Prediction, SegmentModel, widen_sd
from jointfit_daemon.limb_model._weighted_mean import fuse, fuse_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion


@dataclass(frozen=True)
class AlignedModel(SegmentModel):
    """Weighted mean of sensors, each multiplied by constant rotations on both sides."""

    kind: ClassVar[str] = "aligned"

    worlds: tuple[Quaternion, ...]
    """Correction of q_optical_world of each sensor, which is a rotation about the vertical."""
    mounts: tuple[Quaternion, ...]
    """Correction q_segment_bone of the sensor-to-segment alignment of each sensor."""
    weights: tuple[float, ...]
    """Weight of each sensor; the sum is 1."""
    residual_sd: float
    movements: int
    """Number of distinct movements in the training data."""

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the weighted mean, shape (n, 4), as specified by `SegmentModel.predict`."""
        turned = [
            rotation.multiply(rotation.multiply(world, np.asarray(q, dtype=np.float64)), mount)
            for world, q, mount in zip(self.worlds, sensors, self.mounts, strict=True)
        ]
        return fuse(turned, self.weights)

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the weighted mean of one frame."""
        turned = [
            multiply_one(multiply_one(world, q), mount)
            for world, q, mount in zip(self.worlds, sensors, self.mounts, strict=True)
        ]
        sd = widen_sd(self.residual_sd, self.movements)
        return Prediction(fuse_one(turned, self.weights), sd, False)

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> AlignedModel:
        """Return the model described by its JSON form."""
        return cls(
            tuple(as_quaternion(q) for q in data["worlds"]),
            tuple(as_quaternion(q) for q in data["mounts"]),
            tuple(data["weights"]),
            data["residual_sd"],
            data["movements"],
        )
