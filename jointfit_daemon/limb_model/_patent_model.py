r"""Multiple linear regression of quaternion components, in two interpretations of a patent.

.. math:: \hat Y_k = \sum_m a_{k m} X_{m,k} + c_k, \qquad k = w, x, y, z

X are the components of the sensors and Y the components of the segment. The model is a baseline,
published in the Chinese patent CN 114533039 B. ``patent12`` fits every component separately, with
12 parameters for two sensors. ``patent6`` uses the same sensor coefficients for all components,
with 6 parameters. Both are valid only at the heading of the training movement, because of the
intercept c.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from typing_extensions import override  # in typing from Python 3.12 on

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model._segment_model import Prediction, SegmentModel, widen_sd
from jointfit_daemon.limb_model._weighted_mean import equal_weights, fuse, fuse_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

PatentReading = Literal["patent12", "patent6"]

SHORTEST = 0.5
"""Norm of the regression output below which the output is replaced by the mean of the sensors."""


@dataclass(frozen=True)
class PatentModel(SegmentModel):
    """Linear regression of quaternion components, normalized."""

    kind: ClassVar[str] = "patent"

    reading: PatentReading
    coefficients: tuple[tuple[float, ...], ...]
    """Coefficients in four rows w, x, y, z. Each sensor has a column; the last column is the
    intercept.
    """
    q_sign: Quaternion
    """First reference orientation of the training data. The sign of an input is changed if the
    scalar product of the input and this quaternion is negative.
    """
    residual_sd: float
    movements: int
    """Number of distinct movements in the training data."""

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the regression, shape (n, 4), as specified by `SegmentModel.predict`."""
        inputs = [rotation.align_hemisphere(q, self.q_sign) for q in sensors]
        table = np.array(self.coefficients)
        said: Array = table[:, -1] + sum(a * q for a, q in zip(table.T, inputs, strict=False))
        short = np.linalg.norm(said, axis=1) < SHORTEST
        said = rotation.normalize(said)
        said[short] = fuse([q[short] for q in inputs], equal_weights(len(inputs)))
        return said

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the regression of one frame.

        If the norm of the output is below `SHORTEST`, the result is the mean of the sensors, marked
        as extrapolating.
        """
        sd = widen_sd(self.residual_sd, self.movements)
        inputs = [_same_side(q, self.q_sign) for q in sensors]
        said = [
            row[-1] + sum([a * q[k] for a, q in zip(row, inputs, strict=False)])
            for k, row in enumerate(self.coefficients)
        ]

        length = sqrt(sum([c * c for c in said]))
        if length < SHORTEST:
            return Prediction(fuse_one(inputs, equal_weights(len(inputs))), sd, True)
        w, x, y, z = said
        return Prediction((w / length, x / length, y / length, z / length), sd, False)

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> PatentModel:
        """Return the model described by its JSON form."""
        return cls(
            data["reading"],
            tuple(tuple(row) for row in data["coefficients"]),
            as_quaternion(data["q_sign"]),
            data["residual_sd"],
            data["movements"],
        )


def _same_side(q: Quaternion, ref: Quaternion) -> Quaternion:
    if q[0] * ref[0] + q[1] * ref[1] + q[2] * ref[2] + q[3] * ref[3] < 0.0:
        return (-q[0], -q[1], -q[2], -q[3])
    return q
