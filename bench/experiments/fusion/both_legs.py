"""Fusion on both legs: sit-to-stand, left-out movements, coverage, and the static pose.

The trials are from `bench.subjects.skin_marker_knees`, and the subject is the subject of
`bench.subjects.recorded_knee`. The reference poses are computed by this project's inverse
kinematics. In addition to the recorded knee, the trials contain the left leg and sit-to-stand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.recorded_movements import (
    CAUTIOUS,
    DEFAULT,
    NAMES,
    NOTHING,
    TOLERANCE,
    flexion_scores,
    walking_flexion,
)
from bench.framework.experiment import (
    Experiment,
    Result,
    median_and_smallest,
    median_and_worst,
)
from bench.framework.material import BOTH_KNEES, EXCHANGED_KNEES
from bench.subjects.recorded_knee import FOLDER, Judge, training_frames
from bench.subjects.skin_marker_knees import AS_RECORDED, MOVEMENTS, STATIC, SUBJECT, skin_knee
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path

    from bench.subjects.recorded_knee import KneeTrial
    from jointfit_daemon.arrays import Array

    Errors = tuple[float, float, float]

SIDES = {"right": "r", "left": "l"}
EXCHANGED = (AS_RECORDED, (1, 2, 3, 0), (3, 0, 1, 2), (2, 3, 0, 1), (1, 0, 3, 2))
"""Five assignments of the four recorded errors of orientation filters to the four sensors."""
RIVALS = ("mean", "patent12", "linear", DEFAULT)
DEEP_DEG = 40.0


def sit_to_stand(data: Path) -> list[Result]:
    """Train on 60 % of the squats, on walking and on the drop jump; evaluate on sit-to-stand.

    No error of the default method may be larger than the smaller error of `mean` and `patent12`.
    """
    figures = []
    for side, trials in _both(data).items():
        found = _risen(trials)
        for method, errors in found.items():
            goals = _best(found) if method == DEFAULT else (NOTHING,) * 3
            figures += [
                Result(f"{side}, {method}: {name}", error, goal)
                for name, error, goal in zip(NAMES, errors, goals, strict=True)
            ]
    return figures


def exchanged(data: Path) -> list[Result]:
    """Measure the errors of `sit_to_stand` with five assignments of filter errors to sensors.

    The recordings assign one filter error to each sensor. This assignment is arbitrary. The RMS and
    the median over the assignments must not exceed the values of the methods mean and patent12.
    """
    figures = []
    for side in SIDES:
        ways = [_risen(_both(data, errors_of)[side]) for errors_of in EXCHANGED]
        draws = {method: np.array([way[method] for way in ways]) for method in RIVALS}
        rms, medians = (
            {method: summary(errors) for method, errors in draws.items()}
            for summary in (_rms, _medians)
        )
        kept = np.array([np.less_equal(way[DEFAULT], _best(way)) for way in ways])
        for i, name in enumerate(NAMES):
            title = f"{side}, {name}"
            figures += [
                Result(f"{title}: RMS", rms[DEFAULT][i], _best(rms)[i]),
                *median_and_worst(
                    f"{title}: error",
                    draws[DEFAULT][:, i].tolist(),
                    maximum=_best(medians)[i],
                    worst_maximum=NOTHING,
                ),
                Result(f"{title}: within threshold, of 5", float(kept[:, i].sum()), unit=""),
            ]
    return figures


def left_out(data: Path) -> list[Result]:
    """Train on three of four movements, and evaluate on the fourth movement."""
    figures = []
    for side, trials in _both(data).items():
        squats = trials["squats1"]
        judge = Judge.of(squats.part(slice(0, training_frames(squats))))
        for movement, trial in trials.items():
            others = [other for name, other in trials.items() if name != movement]
            found = _errors(judge, others, trial)
            figures += [
                Result(f"{side}, {movement}: {name}", error, goal)
                for name, error, goal in zip(NAMES, found[DEFAULT], _best(found), strict=True)
            ]
    return figures


def coverage(data: Path) -> list[Result]:
    """Measure the coverage of flexion errors on both legs, for all movements.

    The first part trains on three movements and evaluates the fourth. The second part trains on the
    first 60 % of all four movements and evaluates the rest. Median and smallest share are over
    movements and legs.
    """
    unseen, later = [], []
    for trials in _both(data).values():
        begun = [trial.part(slice(0, training_frames(trial))) for trial in trials.values()]
        for movement, trial in trials.items():
            others = [other for name, other in trials.items() if name != movement]
            unseen.append(flexion_scores(others, trial))
            later.append(flexion_scores(begun, trial.part(slice(training_frames(trial), None))))
    figures = []
    for label, scores in (("movements left out", unseen), ("later parts", later)):
        for share, within in ((0.68, 1.0), (0.95, 1.96)):
            name = f"{label}: flexion within {within:g} sd"
            together = float(np.mean(np.abs(np.concatenate(scores)) < within))
            each = [float(np.mean(np.abs(movement) < within)) for movement in scores]
            limits = round(share + TOLERANCE, 9), round(share - TOLERANCE, 9)
            figures += [Result(name, together, *limits, unit=""), *median_and_smallest(name, each)]
    return figures


def standing(data: Path) -> list[Result]:
    """Measure the errors in the static pose of the recorded subject, in natural stance.

    In natural stance, the bones lean and the knees are slightly flexed. The sensor-to-segment
    alignments make the mean of the sensors equal to the reference in this pose, so any correction
    is an error. Each method is trained twice: on all frames of the squats, and on the frames with a
    knee rotation above `DEEP_DEG`.
    """
    figures = []
    for side, trials in _both(data).items():
        squats, static = trials["squats1"], skin_knee(data, STATIC, SIDES[side])
        bend = rotation.angle_between(squats.thigh, squats.shank)
        deep = squats.part(bend > np.deg2rad(DEEP_DEG))
        for label, taught in (("squats", squats), (f"squats beyond {DEEP_DEG:g} deg", deep)):
            for method in ("mean", DEFAULT):
                said = fusion_methods.fit(method, [taught])(static)
                errors = Judge.of(squats).errors(said, static)
                figures += [
                    Result(f"{side}, {label}, {method}: {name}", error, NOTHING)
                    for name, error in zip(NAMES, errors, strict=True)
                ]
        stood = float(np.rad2deg(np.mean(rotation.angle_between(static.thigh, static.shank))))
        figures.append(Result(f"{side}, rotation of the knee in the static pose", stood, NOTHING))
    return figures


def _both(data: Path, errors_of: tuple[int, ...] = AS_RECORDED) -> dict[str, dict[str, KneeTrial]]:
    return {
        side: {movement: skin_knee(data, movement, letter, errors_of) for movement in MOVEMENTS}
        for side, letter in SIDES.items()
    }


def _risen(trials: dict[str, KneeTrial]) -> dict[str, Errors]:
    """Return the errors in sit-to-stand, trained as described in `sit_to_stand`."""
    squats = trials["squats1"]
    begin = squats.part(slice(0, training_frames(squats)))
    taught = [begin, trials["walking1"], trials["DJ1"]]
    return _errors(Judge.of(begin), taught, trials["STS1"])


def _errors(judge: Judge, taught: list[KneeTrial], trial: KneeTrial) -> dict[str, Errors]:
    return {m: judge.errors(fusion_methods.fit(m, taught)(trial), trial) for m in RIVALS}


def _rms(errors: Array) -> Errors:
    a, b, c = np.sqrt(np.mean(np.square(errors), axis=0)).tolist()
    return a, b, c


def _medians(errors: Array) -> Errors:
    a, b, c = np.median(errors, axis=0).tolist()
    return a, b, c


def _best(found: dict[str, Errors]) -> tuple[float, ...]:
    return tuple(round(min(pair), 3) for pair in zip(found["mean"], found["patent12"], strict=True))


_DATA = (FOLDER, SUBJECT)
JUMP_FLEXION = "not known"
EXCHANGED_FLEXION = (
    "the error of flexion depends on the assignment of filter errors to sensors; its RMS "
    "over the assignments is slightly larger than the RMS of the best other method, and its "
    "median is smaller"
)
EXPERIMENTS = (
    Experiment(
        "sit-to-stand-both-legs",
        "Errors in sit-to-stand, trained on squats, walking and drop jump",
        sit_to_stand,
        BOTH_KNEES,
        _DATA,
        headline=True,
    ),
    Experiment(
        "leave-one-movement-out-both-legs",
        "Errors of the default method in each of four movements, which is left out of the training",
        left_out,
        BOTH_KNEES,
        _DATA,
        headline=True,
        known_misses={
            "right, walking1: flexion": walking_flexion("patent12"),
            "left, DJ1: flexion": JUMP_FLEXION,
        },
    ),
    Experiment(
        "flexion-coverage-both-legs",
        "Share of flexion errors within the stated standard deviation, four movements",
        coverage,
        BOTH_KNEES,
        _DATA,
        known_misses={"movements left out: flexion within 1 sd": CAUTIOUS},
    ),
    Experiment(
        "static-pose-correction",
        "Error that the correction causes in the static pose, where the mean equals the reference",
        standing,
        BOTH_KNEES,
        _DATA,
    ),
    Experiment(
        "sit-to-stand-exchanged-filter-errors",
        "Errors in sit-to-stand with five assignments of the filter errors to the sensors",
        exchanged,
        EXCHANGED_KNEES,
        _DATA,
        known_misses={"right, flexion: RMS": EXCHANGED_FLEXION},
    ),
)
