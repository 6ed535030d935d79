"""All ways of fusing the sensors of a knee, side by side, under one name each.

Law: every way is fitted to the same frames and sees the same sensors. ``markley`` learns nothing
but a constant turn of the world and of each mount, and the sensors' weights; ``linear`` is the
ridge of an earlier version of this program, the baseline of the default.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration.anchored import fit_anchored
from jointfit_daemon.calibration.joint_correlation import error_correlation
from jointfit_daemon.calibration.kernel_model import fit_kernel
from jointfit_daemon.calibration.mount import fit_alignment
from jointfit_daemon.calibration.redundancy import fit_segment
from jointfit_daemon.calibration.segment_model import SegmentTraining
from jointfit_daemon.calibration.weighted_mean import fuse, fusion_weights
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from bench.semireal import KneeTrial
    from jointfit_daemon.calibration.segment_model import SegmentModel

    Array = NDArray[np.float64]
    Predict = Callable[[KneeTrial], tuple[Array, Array]]

METHODS = ("single", "mean", "markley", "patent6", "patent12", "linear", "anchored")
"""``anchored`` is the default of the program."""


class Segment(NamedTuple):
    """What one segment's model is given, from a trial."""

    sensors: list[Array]
    other: Array
    bone: Array


def segments(trial: KneeTrial) -> tuple[Segment, Segment]:
    """Return thigh and shank; each sees the mean of its neighbour's sensors."""
    a, b, c, d = trial.sensors
    thigh, shank = fuse([a, b], (0.5, 0.5)), fuse([c, d], (0.5, 0.5))
    return Segment([a, b], shank, trial.thigh), Segment([c, d], thigh, trial.shank)


def fit(method: str, trials: Sequence[KneeTrial]) -> Predict:
    """Return the method, trained; what it returns gives both orientations, shape (n, 4) each."""
    first, second = (_segment(method, training) for training in _training(trials))

    def predict(trial: KneeTrial) -> tuple[Array, Array]:
        thigh, shank = segments(trial)
        return first(thigh), second(shank)

    return predict


def models(trials: Sequence[KneeTrial], method: str = "anchored") -> tuple[SegmentModel, ...]:
    """Return the segment models of a method that has some, thigh and shank."""
    return tuple(_model(method, training) for training in _training(trials))


def correlation(trials: Sequence[KneeTrial]) -> float:
    """Return how far the default's errors of thigh and shank about their x are alike."""
    return error_correlation(*_training(trials))


def _training(trials: Sequence[KneeTrial]) -> Iterator[SegmentTraining]:
    """Give thigh's and shank's frames of all trials, one trial after the other."""
    labels = np.repeat(np.arange(len(trials)), [len(trial) for trial in trials])
    for parts in zip(*(segments(trial) for trial in trials), strict=True):
        sensors = [np.concatenate([part.sensors[i] for part in parts]) for i in (0, 1)]
        other = np.concatenate([part.other for part in parts])
        bone = np.concatenate([part.bone for part in parts])
        yield SegmentTraining.of(sensors, other, bone, labels)


def axis_deviations(model: SegmentModel, segment: Segment) -> Array:
    """Return claimed standard deviations about x, y and z of the segment, rad, shape (n, 3)."""
    rows = []
    for i, other in enumerate(segment.other):
        sensors = [as_quaternion(q[i].tolist()) for q in segment.sensors]
        said = model.predict_one(sensors, as_quaternion(other.tolist()))
        rows.append(said.axis_sd or (said.sd,) * 3)
    return np.array(rows)


def _segment(method: str, training: SegmentTraining) -> Callable[[Segment], Array]:
    if method == "single":
        errors = [rotation.angle_between(q, training.q_reference) for q in training.sensors]
        best = int(np.argmin([np.mean(error**2) for error in errors]))
        return lambda segment: segment.sensors[best]
    if method == "markley":
        return _markley(training)
    model = _model(method, training)
    return lambda segment: model.predict(segment.sensors, segment.other)


def _model(method: str, training: SegmentTraining) -> SegmentModel:
    if method == "linear":
        return fit_anchored(training)
    if method == "anchored":
        return fit_kernel(training)
    if method not in ("mean", "patent6", "patent12"):
        raise ValueError(f"method {method!r}")
    return fit_segment(
        "mean" if method == "mean" else "patent6" if method == "patent6" else "patent12",
        training.sensors,
        training.q_other,
        training.q_reference,
        training.trials,
    )


def _markley(training: SegmentTraining) -> Callable[[Segment], Array]:
    """World turned about the vertical and mount, fitted to each sensor; then the weighted mean."""
    found = [fit_alignment("heading", q, training.q_reference) for q in training.sensors]

    def aligned(sensors: Sequence[Array]) -> list[Array]:
        return [
            rotation.multiply(rotation.multiply(one.q_world, q), one.q_mount)
            for one, q in zip(found, sensors, strict=True)
        ]

    weights = tuple(fusion_weights(aligned(training.sensors), training.q_reference).tolist())
    return lambda segment: fuse(aligned(segment.sensors), weights)
