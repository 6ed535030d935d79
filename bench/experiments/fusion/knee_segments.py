"""Segment errors on the recorded knee: baselines, the default method, and fewer sensors.

The data are from one leg of one subject. Virtual sensors are computed from skin markers, two for
each segment; the reference is a musculoskeletal model. The results detect regressions of the
program. They do not validate it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, near
from bench.framework.material import KNEE
from bench.subjects.recorded_knee import FOLDER, Judge, KneeTrial, load, training_frames
from jointfit_daemon.calibration.soft_tissue import fit_segment
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import fuse

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Method, SegmentModel

NAMES = ("thigh", "shank", "flexion")
THIGH, SHANK = (0, 1), (2, 3)


class KneeModels:
    """Models of both segments, for one method and one selection of sensors.

    The model of a segment also receives the mean of the sensors on the neighbouring segment, like
    the models of the daemon.
    """

    def __init__(
        self,
        method: Method,
        trials: list[KneeTrial],
        thigh: tuple[int, ...] = THIGH,
        shank: tuple[int, ...] = SHANK,
    ) -> None:
        self._thigh, self._shank = thigh, shank
        sensors = [np.concatenate([t.sensors[i] for t in trials]) for i in range(4)]
        labels = np.repeat(np.arange(len(trials)), [len(t) for t in trials])
        femur = np.concatenate([t.thigh for t in trials])
        tibia = np.concatenate([t.shank for t in trials])
        self.thigh: SegmentModel = fit_segment(
            method, [sensors[i] for i in thigh], _mean_of(sensors, shank), femur, labels
        )
        self.shank: SegmentModel = fit_segment(
            method, [sensors[i] for i in shank], _mean_of(sensors, thigh), tibia, labels
        )

    def predict(self, trial: KneeTrial) -> tuple[Array, Array]:
        q = trial.sensors
        return (
            self.thigh.predict([q[i] for i in self._thigh], _mean_of(q, self._shank)),
            self.shank.predict([q[i] for i in self._shank], _mean_of(q, self._thigh)),
        )


def _mean_of(sensors: Sequence[Array], chosen: tuple[int, ...]) -> Array:
    return fuse([sensors[i] for i in chosen], (1.0 / len(chosen),) * len(chosen))


class Squats:
    """The squats, split into training (first 60 %) and hold-out, and their error computation."""

    def __init__(self, data: Path) -> None:
        whole = load(data, "squats1")
        count = training_frames(whole)
        self.training, self.held = whole.part(slice(0, count)), whole.part(slice(count, None))
        self.judge = Judge.of(self.training)


def _single(index: int) -> Callable[[KneeTrial], tuple[Array, Array]]:
    return lambda trial: (trial.sensors[index], trial.sensors[2 + index])


def _mean(trial: KneeTrial) -> tuple[Array, Array]:
    equal = (0.5, 0.5)
    return fuse(trial.sensors[:2], equal), fuse(trial.sensors[2:], equal)


def baselines(data: Path) -> list[Result]:
    """Measure the errors of single sensors, of their mean, and of the patent's regressions."""
    squats = Squats(data)
    said = {
        "single sensor (S2, S4)": (_single(1), (9.04, 9.00, 6.15)),
        "mean": (_mean, (9.29, 9.61, 3.21)),
        "patent12": (KneeModels("patent12", [squats.training]).predict, (3.45, 2.81, 2.11)),
        "patent6": (KneeModels("patent6", [squats.training]).predict, (5.37, 3.83, 4.21)),
    }
    figures = []
    for label, (predict, expected) in said.items():
        errors = squats.judge.errors(predict(squats.held), squats.held)
        figures += [
            near(f"{label}: {name}", error, value, 0.1)
            for name, error, value in zip(NAMES, errors, expected, strict=True)
        ]
    return figures


def _goals(errors: tuple[float, ...], goals: tuple[float, ...], label: str = "") -> list[Result]:
    return [
        Result(f"{label}{name}", error, goal)
        for name, error, goal in zip(NAMES, errors, goals, strict=False)
    ]


def held_out(data: Path) -> list[Result]:
    """Measure the errors of the anchored correction on the last 40 % of the squats."""
    squats = Squats(data)
    models = KneeModels("anchored", [squats.training])
    return _goals(squats.judge.errors(models.predict(squats.held), squats.held), (1.4, 1.6, 1.2))


def _untrained(name: str, goals: tuple[float, ...]) -> Callable[[Path], list[Result]]:
    def run(data: Path) -> list[Result]:
        squats, other = Squats(data), load(data, name)
        models = KneeModels("anchored", [squats.training])
        return _goals(squats.judge.errors(models.predict(other), other), goals)

    return run


def three_movements(data: Path) -> list[Result]:
    """Train on squats, walking and drop jump; measure the errors in the held-out squats."""
    squats = Squats(data)
    trials = [squats.training, load(data, "walking1"), load(data, "DJ1")]
    models = KneeModels("anchored", trials)
    return _goals(squats.judge.errors(models.predict(squats.held), squats.held), (2.0, 1.9, 1.4))


def facing_elsewhere(data: Path) -> list[Result]:
    """Measure the change of fused orientations, apart from the turn, if the subject turns."""
    squats = Squats(data)
    models = KneeModels("anchored", [squats.training])
    straight = models.predict(squats.held)
    worst = 0.0
    for degrees in (10, 30, 90, 170, 180):
        angle = np.deg2rad(degrees)
        turned = models.predict(squats.held.turned(angle))
        for before, after in zip(straight, turned, strict=True):
            back = rotation.multiply(rotation.heading(-angle), after)
            worst = max(worst, float(np.rad2deg(rotation.angle_between(before, back).max())))
    return [Result("largest change of any orientation", worst, 1e-9)]


def one_sensor(data: Path) -> list[Result]:
    """Measure the errors of the models for one sensor, which apply if the other sensor is lost."""
    squats = Squats(data)
    figures = []
    for index, goals in ((0, (1.5, 1.9)), (1, (2.1, 2.0))):
        models = KneeModels("anchored", [squats.training], (index,), (2 + index,))
        errors = squats.judge.errors(models.predict(squats.held), squats.held)
        figures += _goals(errors, goals, f"{('first', 'second')[index]} sensor of each segment: ")
    return figures


_DATA = (FOLDER,)
EXPERIMENTS = (
    Experiment(
        "knee-squat-baselines",
        "Errors of single sensors, mean and the patent's regressions in held-out squats",
        baselines,
        KNEE,
        _DATA,
    ),
    Experiment(
        "knee-squat-holdout",
        "Errors of the default method in held-out squats",
        held_out,
        KNEE,
        _DATA,
        headline=True,
    ),
    Experiment(
        "knee-walking-from-squats",
        "Errors of the default method in walking, trained on squats",
        _untrained("walking1", (5.0, 3.6, 3.3)),
        KNEE,
        _DATA,
        headline=True,
    ),
    Experiment(
        "knee-jump-from-squats",
        "Errors of the default method in a drop jump, trained on squats",
        _untrained("DJ1", (5.2, 4.5, 3.4)),
        KNEE,
        _DATA,
    ),
    Experiment(
        "knee-squat-three-movements",
        "Errors in held-out squats, trained on squats, walking and drop jump",
        three_movements,
        KNEE,
        _DATA,
    ),
    Experiment(
        "knee-heading-invariance",
        "Change of the orientations in held-out squats if the subject is turned by 10 to 180°",
        facing_elsewhere,
        KNEE,
        _DATA,
    ),
    Experiment(
        "knee-single-sensor",
        "Errors in held-out squats with only one sensor on each segment",
        one_sensor,
        KNEE,
        _DATA,
    ),
)
