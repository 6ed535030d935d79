"""All ways of fusing the sensors of a knee, side by side, under one name each.

Law: every way is fitted to the same frames and sees the same sensors. All are the program's own but
``linear``, the ridge of an earlier version, which stays as a baseline of the default.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, cast, get_args

import numpy as np

from bench.baselines.linear_correction import fit_linear_correction
from jointfit_daemon.calibration.soft_tissue import SegmentTraining, error_correlation, fit_segment
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import Method, fuse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from bench.subjects.recorded_knee import KneeTrial
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import SegmentModel

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
    first, second = models(trials, method)

    def predict(trial: KneeTrial) -> tuple[Array, Array]:
        thigh, shank = segments(trial)
        return first.predict(thigh.sensors, thigh.other), second.predict(shank.sensors, shank.other)

    return predict


def models(trials: Sequence[KneeTrial], method: str = "anchored") -> tuple[SegmentModel, ...]:
    """Return the models of thigh and shank."""
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


def _model(method: str, training: SegmentTraining) -> SegmentModel:
    if method == "linear":
        return fit_linear_correction(training)
    if method not in get_args(Method):
        raise ValueError(f"method {method!r}; known: {', '.join(METHODS)}")
    return fit_segment(
        cast("Method", method),
        training.sensors,
        training.q_other,
        training.q_reference,
        training.trials,
    )
