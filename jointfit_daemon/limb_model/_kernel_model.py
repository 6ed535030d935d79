r"""The recommended model: a soft-tissue correction that turns with the subject.

.. math:: \hat q = \bar q \otimes \exp\bigl(\tfrac12 [\eta_a c_a + (1 - \eta_a) T_a]
          + \tfrac12 [\eta_b c_b + (1 - \eta_b) T_b]\bigr)

with the mean :math:`\bar q` of the segment's sensors and two experts of `kernel_expert` on
:math:`\rho = \log(\bar q^* \otimes q_{ref})`: a, who looks at relative rotations alone and carries
over to other movements, and b, who looks at the tilt of the segment, too, and knows the trained
movements better. Inside training they count alike. Outside, their corrections fade (eta) into the
trend T of `kernel_trend`, which carries over best, that of b at once, that of a farther off. About
the long axis there is no trend: there b gives way to a, and a to the mean.

Law: upright and straight, where sensors agree, no leverage is left and nothing is corrected,
wherever training was; a heading changes nothing. What the model is worth is measured on frames that
its fit has not seen, axis by axis, and grows with the distance from training that either expert
sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import perturb_one
from jointfit_daemon.limb_model._kernel_expert import Expert
from jointfit_daemon.limb_model._kernel_features import (
    relative_rotations,
    relative_rotations_one,
    tilts,
    tilts_one,
)
from jointfit_daemon.limb_model._kernel_tables import Tables
from jointfit_daemon.limb_model._kernel_trend import trend
from jointfit_daemon.limb_model._leverage_variance import Spread
from jointfit_daemon.limb_model._segment_model import Prediction, SegmentModel
from jointfit_daemon.limb_model._weighted_mean import equal_weights, fuse, fuse_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

HULL = 3.0
"""The correction of a fades where its leverage exceeds this many times its quantile over training:
root of the ratio. That of b fades from the quantile itself, with the ratio."""
OUTSIDE = 3.0
"""A frame is called extrapolating where the leverage of either exceeds this many times its own."""
SHARE = 0.5
"""Of b. Held-out frames decide too little between two that are nearly alike: a plain mean it is."""


@dataclass(frozen=True)
class KernelModel(SegmentModel):
    """Mean of the sensors and its correction by relative rotations and tilt."""

    kind: ClassVar[str] = "kernel"

    sensors: int
    plain: Expert
    """a."""
    tilted: Expert
    """b."""
    trend: tuple[tuple[float, ...], tuple[float, ...]]
    """T about x and y: coefficients over [1, relative rotations, tilts]."""
    spread: Spread
    residual_sd: float
    mean_sd: float
    """Of the uncorrected mean on the training frames, rad per axis: when the neighbour is lost."""
    _tables: Tables = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Keep the tables as arrays beside: the frame loop multiplies by them."""
        object.__setattr__(self, "_tables", Tables.of(self.plain, self.tilted, self.trend))

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the corrected mean, shape (n, 4); the plain mean without a neighbour."""
        inputs = [np.asarray(q, dtype=np.float64) for q in sensors]
        mean = fuse(inputs, equal_weights(len(inputs)))
        if q_other is None:
            return mean
        u = model_inputs(inputs, mean, np.asarray(q_other, dtype=np.float64))
        a, a_ratio = self.plain.correct(u, self.sensors)
        b, b_ratio = self.tilted.correct(u, self.sensors)
        correction = mix_corrections(trend(self.trend, u), a, a_ratio, b, b_ratio)
        return rotation.multiply(mean, rotation.exp(correction))

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the corrected mean of one frame, its standard deviations by its leverage."""
        mean = fuse_one(sensors, equal_weights(len(sensors)))
        if q_other is None:
            return Prediction(mean, self.mean_sd, False)
        u = relative_rotations_one(sensors, mean, q_other)
        a, ratio, b, b_ratio, (tx, ty) = self._tables.correct(u, tilts_one(mean))
        p = 1.0 - SHARE if ratio <= HULL else (1.0 - SHARE) * sqrt(HULL / ratio)
        s = SHARE / b_ratio if b_ratio > 1.0 else SHARE
        (ax, ay, az), (bx, by, bz) = a, b
        rest, along = 1.0 - p - s, p / (1.0 - SHARE)
        c = (
            p * ax + s * bx + rest * tx,
            p * ay + s * by + rest * ty,
            along * (1.0 - s) * az + s * bz,
        )
        far = max(ratio, b_ratio)
        sds = self.spread.at(far)
        x, y, z = sds
        sd = sqrt((x * x + y * y + z * z) / 3.0)
        return Prediction(perturb_one(mean, c), sd, far > OUTSIDE, sds)

    @override
    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "kind": self.kind,
            "sensors": self.sensors,
            "plain": self.plain.to_dict(),
            "tilted": self.tilted.to_dict(),
            "trend": [list(row) for row in self.trend],
            "spread": self.spread.to_dict(),
            "residual_sd": self.residual_sd,
            "mean_sd": self.mean_sd,
        }

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> KernelModel:
        """Return the model of its JSON form."""
        return cls(
            sensors=data["sensors"],
            plain=Expert.read(data["plain"]),
            tilted=Expert.read(data["tilted"]),
            trend=_rows_xy(data["trend"]),
            spread=Spread.read(data["spread"]),
            residual_sd=data["residual_sd"],
            mean_sd=data["mean_sd"],
        )


def model_inputs(sensors: Sequence[Array], mean: Array, q_other: Array) -> Array:
    u = relative_rotations(sensors, mean, q_other)
    return np.concatenate([u, tilts(mean)], axis=1)


def mix_corrections(line: Array, a: Array, a_ratio: Array, b: Array, b_ratio: Array) -> Array:
    """Return the correction by both experts and the trend together, rad, shape (n, 3)."""
    inside_a = 1.0 / np.sqrt(np.maximum(a_ratio / HULL, 1.0))[:, None]
    inside_b = 1.0 / np.maximum(b_ratio, 1.0)[:, None]
    plain = inside_a * a + (1.0 - inside_a) * line
    instead_of_b = np.concatenate([line[:, :2], plain[:, 2:]], axis=1)
    tilted = inside_b * b + (1.0 - inside_b) * instead_of_b
    mixed: Array = (1.0 - SHARE) * plain + SHARE * tilted
    return mixed


def _rows_xy(rows: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    x, y = rows
    return tuple(x), tuple(y)
