r"""The recommended model: a soft-tissue correction that turns with the subject.

.. math:: \hat q = \bar q \otimes \exp(\eta\, \mathrm{clip}(C^T \varphi))

with the mean :math:`\bar q` of the segment's sensors, phi the smooth terms and bumps of
`kernel_features`, C the robust ridge fit of :math:`\rho = \log(\bar q^* \otimes q_{ref})` of
`kernel_ridge`.

Law: zero correction in the static pose; exactly equivariant under turns of the world; outside the
hull of the training movements the correction fades (eta) instead of growing. What it is worth is
measured on frames that the fit has not seen, axis by axis.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.calibration import kernel_features as features
from jointfit_daemon.calibration.held_out_spread import Spread, hull, measure_spread
from jointfit_daemon.calibration.kernel_ridge import Basis, choose, fit
from jointfit_daemon.calibration.segment_model import Prediction, SegmentModel, SegmentTraining
from jointfit_daemon.calibration.weighted_mean import fuse, fuse_one
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import exp_one, multiply_one

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.model import Quaternion

    Array = NDArray[np.float64]

LARGEST = 0.4
"""No component of a correction exceeds this, rad."""
HULL = 10.0
"""The correction fades where the leverage exceeds this many times the training's 0.995 quantile."""
OUTSIDE = 3.0
"""And the frame is called extrapolating where it exceeds this many times."""
BLOCKS = 3
"""Of a single trial: few and long ones, so that each holds movement the others do not."""


@dataclass(frozen=True)
class KernelModel(SegmentModel):
    """Mean of the sensors and its correction by relative rotations."""

    kind: ClassVar[str] = "kernel"

    sensors: int
    coefficients: tuple[tuple[float, ...], ...]
    """C^T: three rows, rad per unit of each smooth term and bump."""
    centers: tuple[tuple[float, ...], ...]
    """Of the bumps, in lengths."""
    leverage: tuple[tuple[float, ...], ...]
    """Square: ``s @ leverage @ s`` of smooth terms s: how far a frame lies outside training."""
    hull_leverage: float
    """0.995 quantile of the leverage over training."""
    spread: Spread
    residual_sd: float
    mean_sd: float
    """Of the uncorrected mean on the training frames, rad per axis: when the neighbour is lost."""
    penalties: tuple[tuple[float, float], ...]
    """Chosen per axis: ratio of bumps to smooth terms, and penalty."""
    _arrays: _Arrays = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Keep the tables as arrays beside: the frame loop multiplies by them."""
        object.__setattr__(self, "_arrays", _Arrays.of(self))

    @override
    def predict(self, sensors: Sequence[ArrayLike], q_other: ArrayLike | None = None) -> Array:
        """Return the corrected mean, shape (n, 4); the plain mean without a neighbour."""
        inputs = [np.asarray(q, dtype=np.float64) for q in sensors]
        mean = fuse(inputs, _equal(len(inputs)))
        if q_other is None:
            return mean
        arrays = self._arrays
        u = features.relative_rotations(inputs, mean, np.asarray(q_other, dtype=np.float64))
        smooth = features.smooth_terms(u)
        phi = np.concatenate([smooth, features.bumps(u / arrays.lengths, arrays.centers)], axis=1)
        ratio = np.einsum("ij,jk,ik->i", smooth, arrays.leverage, smooth) / self.hull_leverage
        fade = 1.0 / np.sqrt(np.maximum(ratio / HULL, 1.0))
        correction = np.clip(phi @ arrays.C.T, -LARGEST, LARGEST)
        return rotation.multiply(mean, rotation.exp(fade[:, None] * correction))

    @override
    def predict_one(
        self, sensors: Sequence[Quaternion], q_other: Quaternion | None = None
    ) -> Prediction:
        """Return the corrected mean of one frame, its standard deviations by its leverage."""
        mean = fuse_one(sensors, _equal(len(sensors)))
        if q_other is None:
            return Prediction(mean, self.mean_sd, False)
        arrays = self._arrays
        u = features.relative_rotations_one(sensors, mean, q_other)
        x, y, z, ratio = arrays.correct(u)
        fade = 1.0 if ratio <= HULL else sqrt(HULL / ratio)
        turn = (fade * _clipped(x), fade * _clipped(y), fade * _clipped(z))
        sds = self.spread.at(ratio)
        sd = sqrt((sds[0] ** 2 + sds[1] ** 2 + sds[2] ** 2) / 3.0)
        return Prediction(multiply_one(mean, exp_one(turn)), sd, ratio > OUTSIDE, sds)

    @override
    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "kind": self.kind,
            "sensors": self.sensors,
            "coefficients": [list(row) for row in self.coefficients],
            "centers": [list(row) for row in self.centers],
            "leverage": [list(row) for row in self.leverage],
            "hull_leverage": self.hull_leverage,
            "spread": self.spread.to_dict(),
            "residual_sd": self.residual_sd,
            "mean_sd": self.mean_sd,
            "penalties": [list(row) for row in self.penalties],
        }

    @classmethod
    @override
    def read(cls, data: Mapping[str, Any]) -> KernelModel:
        """Return the model of its JSON form."""
        return cls(
            sensors=data["sensors"],
            coefficients=_tuples(data["coefficients"]),
            centers=_tuples(data["centers"]),
            leverage=_tuples(data["leverage"]),
            hull_leverage=data["hull_leverage"],
            spread=Spread.read(data["spread"]),
            residual_sd=data["residual_sd"],
            mean_sd=data["mean_sd"],
            penalties=tuple((ratio, penalty) for ratio, penalty in data["penalties"]),
        )


@dataclass(frozen=True, slots=True)
class _Arrays:
    """Tables as the loops want them; for single frames in as few products as can be."""

    C: Array
    centers: Array
    leverage: Array
    lengths: Array
    of_smooth: Array
    """C of smooth terms above the root of the leverage over its quantile, shape (3 + s, s)."""
    exponents: Array
    """Times [x, |x|^2 / 2, 1] it is -|x - z|^2 / 2 of every center, shape (m, width + 2)."""
    of_bumps: Array
    """C of bumps, shape (3, m)."""
    still: tuple[float, float, float]
    """C of bumps summed: what exp(-|x|^2 / 2) takes away from each."""
    rest: tuple[float, float, float]
    """And what the constant of each bump adds."""

    @staticmethod
    def of(model: KernelModel) -> _Arrays:
        width = 3 * model.sensors
        C, leverage = np.array(model.coefficients), np.array(model.leverage)
        centers = np.array(model.centers, dtype=np.float64).reshape(-1, width)
        half = 0.5 * np.sum(centers**2, axis=1)
        s = C.shape[1] - len(centers)
        of_bumps = np.ascontiguousarray(C[:, s:])
        root = np.linalg.cholesky(leverage / model.hull_leverage).T
        ones = np.ones((len(centers), 1))
        return _Arrays(
            C=C,
            centers=centers,
            leverage=leverage,
            lengths=features.lengths(width),
            of_smooth=np.concatenate([C[:, :s], root]),
            exponents=np.concatenate([centers, -ones, -half[:, None]], axis=1),
            of_bumps=of_bumps,
            still=_three(of_bumps.sum(axis=1)),
            rest=_three(of_bumps @ (1.0 - np.exp(-half))),
        )

    def correct(self, u: Sequence[float]) -> tuple[float, float, float, float]:
        """Return the correction of one frame, rad, and its leverage over the quantile."""
        scaled = features.scaled_one(u)
        near = np.exp(self.exponents @ np.array(scaled))
        x, y, z = (self.of_bumps @ near).tolist()
        sx, sy, sz, *far = (self.of_smooth @ np.array(features.smooth_terms_one(u))).tolist()
        e = exp(-scaled[-2])
        a, b = self.still, self.rest
        ratio = sum([c * c for c in far])
        return (
            x + sx + b[0] - e * a[0],
            y + sy + b[1] - e * a[1],
            z + sz + b[2] - e * a[2],
            ratio,
        )


def fit_kernel(training: SegmentTraining) -> KernelModel:
    """Fit the correction; its penalties and its claimed variance come from held-out groups.

    Penalties are chosen twice where several trials train: by leaving out whole trials, which asks
    what carries over to another movement, and by leaving out blocks of each, which asks what
    carries over within one. The fits by both choices are averaged.

    Raises
    ------
    ValueError
        There is no neighbouring segment to look at.
    """
    if training.q_other is None:
        raise ValueError("the anchored model needs a sensor of the neighbouring segment")
    mean = fuse(training.sensors, _equal(len(training.sensors)))
    rho = rotation.log(rotation.multiply(rotation.conjugate(mean), training.q_reference))
    u = features.relative_rotations(training.sensors, mean, training.q_other)
    x = u / features.lengths(u.shape[1])
    centers, smooth = features.spread_centers(x), features.smooth_terms(u)
    basis = Basis.of(smooth, features.bumps(x, centers), features.bumps(centers, centers))
    ways = [list(training.folds(BLOCKS))]
    if training.movements > 1:
        ways.append([training.trials == label for label in np.unique(training.trials)])
    held = [choose(basis, rho, groups) for groups in ways]
    C = np.mean([fit(basis, rho, each.choice) for each in held], axis=0)
    leverage = hull(smooth)
    h = np.einsum("ij,jk,ik->i", smooth, leverage, smooth)
    hull_leverage = float(np.quantile(h, 0.995))
    spread = measure_spread(smooth, [each.residuals for each in held], ways)
    return KernelModel(
        sensors=len(training.sensors),
        coefficients=_tuples(C.T.tolist()),
        centers=_tuples(centers.tolist()),
        leverage=_tuples(leverage.tolist()),
        hull_leverage=hull_leverage,
        spread=spread,
        residual_sd=_sd(held[-1].residuals),
        mean_sd=_sd(rho),
        penalties=held[-1].choice,
    )


def _sd(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)) / 3.0))


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def _equal(count: int) -> tuple[float, ...]:
    return (1.0 / count,) * count


def _tuples(rows: Iterable[Iterable[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in rows)


def _clipped(value: float) -> float:
    return min(max(value, -LARGEST), LARGEST)
