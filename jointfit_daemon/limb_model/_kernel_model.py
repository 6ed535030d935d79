r"""Recommended model: mean of the sensors with a posture-dependent soft-tissue correction.

.. math:: \hat q = \bar q \otimes \exp\bigl((1 - w) [\eta_a c_a + (1 - \eta_a) T_a]
          + w [\eta_b c_b + (1 - \eta_b) T_b]\bigr)

:math:`\bar q` is the mean of the sensors of the segment, and :math:`q_{ref}` is the optical
reference of the training. The corrections :math:`c_a` and :math:`c_b` are two fits (`KernelExpert`)
of :math:`\rho = \log(\bar q^* \otimes q_{ref})`. Expert a uses only relative rotations and
generalizes to other movements. Expert b also uses the tilt of the segment and has smaller errors
than expert a on the trained movements. The weight w of expert b is 1 in the middle of the training
range, decreases towards the limit of this range, and is 1/2 outside.

Outside the training range, the factors :math:`\eta` decrease, and the linear trend T of
`_kernel_trend` replaces the experts, because the trend extrapolates best. The factor of expert b
decreases from the limit of the training range on, the factor of expert a from a larger distance on.
:math:`T_a` and :math:`T_b` are equal to T about x and y. T has no component about the long axis z.
About z, :math:`T_a` is zero, and :math:`T_b` is :math:`\eta_a c_a`, the correction of expert a.

Invariants: the correction is zero if the segment is upright, the joint is straight and the sensors
agree. A rotation of the world about the vertical does not change the correction.

The standard deviations about the axes are estimated on held-out frames. They increase with the
larger leverage ratio of the two experts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # in typing from Python 3.12 on

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import perturb_one
from jointfit_daemon.limb_model._kernel_expert import KernelExpert, as_rows
from jointfit_daemon.limb_model._kernel_features import (
    relative_rotations,
    relative_rotations_one,
    tilts,
    tilts_one,
)
from jointfit_daemon.limb_model._kernel_tables import KernelTables
from jointfit_daemon.limb_model._kernel_trend import trend
from jointfit_daemon.limb_model._leverage_variance import WITHIN, LeverageVariance
from jointfit_daemon.limb_model._segment_model import Prediction, SegmentModel
from jointfit_daemon.limb_model._weighted_mean import equal_weights, fuse, fuse_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

HULL = 3.0
"""Leverage ratio r of expert a above which its factor η is √(HULL / r). The factor of expert b is
1 / r if the leverage ratio r of expert b exceeds 1.
"""
OUTSIDE = 3.0
"""Leverage ratio of an expert above which a frame counts as extrapolation."""
OUTSIDE_WEIGHT = 0.5
"""Weight w of expert b at a leverage ratio of 1 and above. Up to the leverage ratio `WITHIN` the
weight is 1; between both ratios it is linear.
"""


@dataclass(frozen=True)
class KernelModel(SegmentModel):
    """Mean of the sensors, corrected by relative rotations and tilt."""

    kind: ClassVar[str] = "kernel"

    sensors: int
    plain: KernelExpert
    """Expert a, a regression on relative rotations."""
    tilted: KernelExpert
    """Expert b, a regression on relative rotations and tilt."""
    trend: tuple[tuple[float, ...], tuple[float, ...]]
    """Coefficients of the trend T about x and y, for [1, relative rotations, tilts]."""
    spread: LeverageVariance
    residual_sd: float
    mean_sd: float
    """Standard deviation of the uncorrected mean in training, rad per axis. It is the standard
    deviation of the output if the neighboring segment has no data.
    """
    _tables: KernelTables = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Compute the arrays that are multiplied in every frame.

        Raises
        ------
        ValueError
            A width or leverage is zero, a leverage matrix is not positive definite, or a center is
            out of range.
        """
        try:
            with np.errstate(divide="raise", over="raise", invalid="raise"):
                tables = KernelTables.of(self.plain, self.tilted, self.trend)
        except FloatingPointError as error:
            raise ValueError(f"kernel width, center or leverage out of range: {error}") from error
        object.__setattr__(self, "_tables", tables)

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the corrected mean, shape (n, 4), or the plain mean without a neighbor."""
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
        """Return the corrected mean of one frame and its standard deviations from the leverage."""
        mean = fuse_one(sensors, equal_weights(len(sensors)))
        if q_other is None:
            return Prediction(mean, self.mean_sd, False)
        u = relative_rotations_one(sensors, mean, q_other)
        a, ratio, b, b_ratio, (tx, ty) = self._tables.correct(u, tilts_one(mean))

        # Share of each expert: its weight times its factor. The trend has the rest.
        inside = 1.0 if ratio <= HULL else sqrt(HULL / ratio)
        if b_ratio >= 1.0:
            weight = OUTSIDE_WEIGHT
            s = weight / b_ratio
        else:
            weight = 1.0 - (1.0 - OUTSIDE_WEIGHT) * max(b_ratio - WITHIN, 0.0) / (1.0 - WITHIN)
            s = weight
        p = (1.0 - weight) * inside
        rest = 1.0 - p - s

        # There is no trend about z. Outside the training range, the correction of expert a replaces
        # the correction of expert b, and zero replaces the correction of expert a.
        (ax, ay, az), (bx, by, bz) = a, b
        c = (
            p * ax + s * bx + rest * tx,
            p * ay + s * by + rest * ty,
            inside * (1.0 - s) * az + s * bz,
        )

        far = max(ratio, b_ratio)
        sds = self.spread.at(far)
        x, y, z = sds
        sd = sqrt((x * x + y * y + z * z) / 3.0)
        return Prediction(perturb_one(mean, c), sd, far > OUTSIDE, sds)

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> KernelModel:
        """Return the model described by its JSON form."""
        trend_x, trend_y = as_rows(data["trend"])
        return cls(
            sensors=data["sensors"],
            plain=KernelExpert.read(data["plain"]),
            tilted=KernelExpert.read(data["tilted"]),
            trend=(trend_x, trend_y),
            spread=LeverageVariance.read(data["spread"]),
            residual_sd=data["residual_sd"],
            mean_sd=data["mean_sd"],
        )


def model_inputs(sensors: Sequence[Array], mean: Array, q_other: Array) -> Array:
    """Return relative rotations and tilts of all frames, rad, shape (n, 3 m + 3)."""
    u = relative_rotations(sensors, mean, q_other)
    return np.concatenate([u, tilts(mean)], axis=1)


def mix_corrections(line: Array, a: Array, a_ratio: Array, b: Array, b_ratio: Array) -> Array:
    """Return the combined correction of both experts and the trend, rad, shape (n, 3)."""
    inside_a = 1.0 / np.sqrt(np.maximum(a_ratio / HULL, 1.0))[:, None]
    inside_b = 1.0 / np.maximum(b_ratio, 1.0)[:, None]
    plain = inside_a * a + (1.0 - inside_a) * line
    instead_of_b = np.concatenate([line[:, :2], plain[:, 2:]], axis=1)
    tilted = inside_b * b + (1.0 - inside_b) * instead_of_b

    beyond = np.clip((b_ratio - WITHIN) / (1.0 - WITHIN), 0.0, 1.0)[:, None]
    weight = 1.0 - (1.0 - OUTSIDE_WEIGHT) * beyond
    mixed: Array = (1.0 - weight) * plain + weight * tilted
    return mixed
