"""Weighted mean of the sensors without a correction. The mean needs no neighboring segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # in typing from Python 3.12 on

from jointfit_daemon.limb_model._segment_model import Prediction, SegmentModel
from jointfit_daemon.limb_model._weighted_mean import fuse, fuse_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion


@dataclass(frozen=True)
class MeanModel(SegmentModel):
    """Weighted mean of the sensors of a segment."""

    kind: ClassVar[str] = "mean"

    weights: tuple[float, ...]
    """Weight of each sensor; the sum is 1."""
    residual_sd: float

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the weighted mean, shape (n, 4), as specified by `SegmentModel.predict`."""
        return fuse([np.asarray(q, dtype=np.float64) for q in sensors], self.weights)

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the weighted mean of one frame."""
        return Prediction(fuse_one(sensors, self.weights), self.residual_sd, False)

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> MeanModel:
        """Return the model described by its JSON form."""
        return cls(tuple(data["weights"]), data["residual_sd"])
