r"""The recommended model: a soft-tissue correction that turns with the subject.

.. math:: \hat q = \bar q \otimes \exp(\eta_a c_a + \tfrac12 \eta_b (c_b - \eta_a c_a))

with the mean :math:`\bar q` of the segment's sensors and two experts of `kernel_expert` on
:math:`\rho = \log(\bar q^* \otimes q_{ref})`: a, who looks at relative rotations alone and carries
over to other movements, and b, who looks at the tilt of the segment, too, and knows the trained
movements better. Inside training they count alike.

Law: nothing is corrected in the static pose; a person's heading changes nothing; outside the hull
of training the corrections fade (eta) instead of growing, that of b at once, that of a far outside.
What the model is worth is measured on frames that its fit has not seen, axis by axis, and grows
with the distance from training that either expert sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.calibration import kernel_features as features
from jointfit_daemon.calibration.held_out_spread import Spread, measure_spread
from jointfit_daemon.calibration.kernel_expert import Expert, fit_expert
from jointfit_daemon.calibration.kernel_tables import Tables
from jointfit_daemon.calibration.segment_model import Prediction, SegmentModel, SegmentTraining
from jointfit_daemon.calibration.weighted_mean import fuse, fuse_one
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import exp_one, multiply_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.model import Quaternion

    Array = NDArray[np.float64]

HULL = 10.0
"""The correction of a fades where its leverage exceeds this many times its quantile over training:
root of the ratio. That of b fades from the quantile itself, with the ratio."""
OUTSIDE = 3.0
"""A frame is called extrapolating where the leverage of either exceeds this many times its own."""
BLOCKS = 3
"""Of a single trial: few and long ones, so that each holds movement the others do not."""
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
    spread: Spread
    residual_sd: float
    mean_sd: float
    """Of the uncorrected mean on the training frames, rad per axis: when the neighbour is lost."""
    _tables: Tables = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Keep the tables as arrays beside: the frame loop multiplies by them."""
        object.__setattr__(self, "_tables", Tables.of(self.plain, self.tilted, self.sensors))

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the corrected mean, shape (n, 4); the plain mean without a neighbour."""
        inputs = [np.asarray(q, dtype=np.float64) for q in sensors]
        mean = fuse(inputs, _equal(len(inputs)))
        if q_other is None:
            return mean
        u = _seen(inputs, mean, np.asarray(q_other, dtype=np.float64))
        a, a_ratio = self.plain.correct(u, self.sensors)
        b, b_ratio = self.tilted.correct(u, self.sensors)
        correction = _mixed(a, a_ratio, b, b_ratio)
        return rotation.multiply(mean, rotation.exp(correction))

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the corrected mean of one frame, its standard deviations by its leverage."""
        mean = fuse_one(sensors, _equal(len(sensors)))
        if q_other is None:
            return Prediction(mean, self.mean_sd, False)
        u = features.relative_rotations_one(sensors, mean, q_other)
        a, ratio, b, b_ratio = self._tables.correct(u, features.tilts_one(mean))
        fade = 1.0 if ratio <= HULL else sqrt(HULL / ratio)
        tilted = SHARE / b_ratio if b_ratio > 1.0 else SHARE
        plain = fade * (1.0 - tilted)
        (ax, ay, az), (bx, by, bz) = a, b
        c = (plain * ax + tilted * bx, plain * ay + tilted * by, plain * az + tilted * bz)
        far = max(ratio, b_ratio)
        sds = self.spread.at(far)
        x, y, z = sds
        sd = sqrt((x * x + y * y + z * z) / 3.0)
        return Prediction(multiply_one(mean, exp_one(c)), sd, far > OUTSIDE, sds)

    @override
    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "kind": self.kind,
            "sensors": self.sensors,
            "plain": self.plain.to_dict(),
            "tilted": self.tilted.to_dict(),
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
            spread=Spread.read(data["spread"]),
            residual_sd=data["residual_sd"],
            mean_sd=data["mean_sd"],
        )


def fit_kernel(training: SegmentTraining) -> KernelModel:
    """Fit both experts; all that is chosen, and the claimed variance, come from held-out groups.

    Groups are blocks in time and, where several trials train, whole trials as well.

    Raises
    ------
    ValueError
        There is no neighbouring segment to look at.
    """
    if training.q_other is None:
        raise ValueError("the anchored model needs a sensor of the neighbouring segment")
    count = len(training.sensors)
    mean = fuse(training.sensors, _equal(count))
    rho = rotation.log(rotation.multiply(rotation.conjugate(mean), training.q_reference))
    u = _seen(training.sensors, mean, training.q_other)
    ways = [list(training.folds(BLOCKS))]
    if training.movements > 1:
        ways.append([training.trials == label for label in np.unique(training.trials)])
    plain = fit_expert(u, rho, count, ways, tilted=False)
    tilted = fit_expert(u, rho, count, ways, tilted=True)
    distances = list(zip(plain.ratios, tilted.ratios, strict=True))
    residuals = [
        rho - _mixed(a, a_ratio, b, b_ratio)
        for a, a_ratio, b, b_ratio in zip(
            plain.unseen, plain.ratios, tilted.unseen, tilted.ratios, strict=True
        )
    ]
    return KernelModel(
        sensors=count,
        plain=plain.expert,
        tilted=tilted.expert,
        spread=measure_spread([np.maximum(a, b) for a, b in distances], residuals),
        residual_sd=_sd(residuals[-1]),
        mean_sd=_sd(rho),
    )


def _seen(sensors: Sequence[Array], mean: Array, q_other: Array) -> Array:
    u = features.relative_rotations(sensors, mean, q_other)
    return np.concatenate([u, features.tilts(mean)], axis=1)


def _mixed(a: Array, a_ratio: Array, b: Array, b_ratio: Array) -> Array:
    """Return the correction that both experts make together, rad, shape (n, 3)."""
    faded = a / np.sqrt(np.maximum(a_ratio / HULL, 1.0))[:, None]
    share = SHARE / np.maximum(b_ratio, 1.0)
    mixed: Array = faded + share[:, None] * (b - faded)
    return mixed


def _sd(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)) / 3.0))


@cache
def _equal(count: int) -> tuple[float, ...]:
    return (1.0 / count,) * count
