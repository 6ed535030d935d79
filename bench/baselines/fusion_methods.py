"""All methods that fuse the sensors of a knee, by name.

Invariant: every method is fitted to the same frames and uses the same sensors. All methods are part
of the program, except ``linear``, a ridge regression that serves as a baseline.
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
"""Names of the methods. ``anchored`` is the default of the program."""


class SegmentInputs(NamedTuple):
    """Orientations for one segment, shape (n, 4) each: sensors, neighbouring segment, bone.

    The bone is the reference.
    """

    sensors: list[Array]
    other: Array
    bone: Array


def segments(trial: KneeTrial) -> tuple[SegmentInputs, SegmentInputs]:
    """Return the inputs of thigh and shank; `other` is the mean of the neighbour's sensors."""
    a, b, c, d = trial.sensors
    thigh, shank = fuse([a, b], (0.5, 0.5)), fuse([c, d], (0.5, 0.5))
    return SegmentInputs([a, b], shank, trial.thigh), SegmentInputs([c, d], thigh, trial.shank)


def fit(method: str, trials: Sequence[KneeTrial]) -> Predict:
    """Fit a method; return a function from a trial to both orientations, shape (n, 4) each."""
    first, second = models(trials, method)

    def predict(trial: KneeTrial) -> tuple[Array, Array]:
        thigh, shank = segments(trial)
        return first.predict(thigh.sensors, thigh.other), second.predict(shank.sensors, shank.other)

    return predict


def models(trials: Sequence[KneeTrial], method: str = "anchored") -> tuple[SegmentModel, ...]:
    """Return the models of thigh and shank."""
    return tuple(_model(method, training) for training in _training(trials))


def correlation(trials: Sequence[KneeTrial]) -> float:
    """Return the correlation between the errors of thigh and shank about x, default method."""
    return error_correlation(*_training(trials))


def _training(trials: Sequence[KneeTrial]) -> Iterator[SegmentTraining]:
    """Yield the training frames of thigh and of shank, concatenated over the trials."""
    labels = np.repeat(np.arange(len(trials)), [len(trial) for trial in trials])
    for parts in zip(*(segments(trial) for trial in trials), strict=True):
        sensors = [np.concatenate([part.sensors[i] for part in parts]) for i in (0, 1)]
        other = np.concatenate([part.other for part in parts])
        bone = np.concatenate([part.bone for part in parts])
        yield SegmentTraining.of(sensors, other, bone, labels)


def axis_deviations(model: SegmentModel, segment: SegmentInputs) -> Array:
    """Return predicted standard deviations about x, y and z of the segment, rad, shape (n, 3)."""
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
