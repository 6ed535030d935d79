"""Fusion on both legs: sit-to-stand, left-out movements, coverage, and the static pose.

The trials of `skin_marker_knees` show the subject of the recorded knee. Their poses are from the
inverse kinematics of this project. They add the left leg and sit-to-stand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.recorded_movements import (
    DEFAULT,
    NAMES,
    NOTHING,
    TOLERANCE,
    flexion_scores,
)
from bench.framework.experiment import Experiment, Result
from bench.framework.material import BOTH_KNEES, EXCHANGED_KNEES
from bench.subjects.recorded_knee import FOLDER, Judge, training_frames
from bench.subjects.skin_marker_knees import AS_RECORDED, MOVEMENTS, STATIC, SUBJECT, skin_knee
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path

    from bench.subjects.recorded_knee import KneeTrial

    Errors = tuple[float, float, float]

SIDES = {"right": "r", "left": "l"}
EXCHANGED = (AS_RECORDED, (1, 2, 3, 0), (3, 0, 1, 2), (2, 3, 0, 1), (1, 0, 3, 2))
"""Assignments of the recorded filter errors to the sensors."""
RIVALS = ("mean", "patent12", "linear", DEFAULT)
DEEP_DEG = 40.0


def sit_to_stand(data: Path) -> list[Result]:
    """Train on 60 % of the squats, walking and the jump; evaluate on sit-to-stand.

    No result of the default method may be worse than the mean of two sensors or patent12.
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
    """Measure the errors of `sit_to_stand` with exchanged filter errors, RMS of five assignments.

    The recordings assign one filter error to each sensor. This assignment is arbitrary.
    """
    figures = []
    for side in SIDES:
        ways = [_risen(_both(data, errors_of)[side]) for errors_of in EXCHANGED]
        found: dict[str, Errors] = {}
        for method in RIVALS:
            a, b, c = np.sqrt(np.mean(np.square([way[method] for way in ways]), axis=0)).tolist()
            found[method] = (a, b, c)
        figures += [
            Result(f"{side}: {name}", error, goal)
            for name, error, goal in zip(NAMES, found[DEFAULT], _best(found), strict=True)
        ]
        kept = [np.less_equal(way[DEFAULT], _best(way)) for way in ways]
        for i, name in enumerate(NAMES):
            count = float(sum(each[i] for each in kept))
            figures.append(
                Result(
                    f"{side}: {name} within threshold, of 5 assignments", count, NOTHING, unit=""
                )
            )
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

    The first part evaluates left-out movements. The second part evaluates the last 40 % of each
    movement after training on the first 60 % of all four.
    """
    unseen, later = [], []
    for trials in _both(data).values():
        begun = [trial.part(slice(0, training_frames(trial))) for trial in trials.values()]
        for movement, trial in trials.items():
            others = [other for name, other in trials.items() if name != movement]
            unseen.append(flexion_scores(others, trial))
            later.append(flexion_scores(begun, trial.part(slice(training_frames(trial), None))))
    return [
        Result(
            f"{label}: flexion within {within:g} sd",
            float(np.mean(np.abs(np.concatenate(scores)) < within)),
            round(share + TOLERANCE, 9),
            minimum=round(share - TOLERANCE, 9),
            unit="",
        )
        for label, scores in (("movements left out", unseen), ("later parts", later))
        for share, within in ((0.68, 1.0), (0.95, 1.96))
    ]


def standing(data: Path) -> list[Result]:
    """Measure the errors in the static pose of the recorded subject, in natural stance.

    In natural stance, the bones lean and the knees are slightly flexed. The sensor-to-segment
    alignments make the mean equal to the reference, so any correction is an error. The methods are
    trained on squats, and on the part of the squats with larger flexion alone.
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
    """Return the errors in sit-to-stand after training on 60 % of squats, walking and jump."""
    squats = trials["squats1"]
    begin = squats.part(slice(0, training_frames(squats)))
    taught = [begin, trials["walking1"], trials["DJ1"]]
    return _errors(Judge.of(begin), taught, trials["STS1"])


def _errors(judge: Judge, taught: list[KneeTrial], trial: KneeTrial) -> dict[str, Errors]:
    return {m: judge.errors(fusion_methods.fit(m, taught)(trial), trial) for m in RIVALS}


def _best(found: dict[str, Errors]) -> tuple[float, ...]:
    return tuple(round(min(pair), 3) for pair in zip(found["mean"], found["patent12"], strict=True))


_DATA = (FOLDER, SUBJECT)
WALKING_FLEXION = (
    "in walking, the thigh and shank errors of patent12 are nearly equal and cancel in "
    "flexion; the training movements do not determine which correction is valid in walking"
)
JUMP_FLEXION = "not known"
EXCHANGED_FLEXION = (
    "the error of flexion depends on the assignment of filter errors to sensors; its mean "
    "over the assignments is slightly larger than the mean of the best other method"
)
SHORT_TRAINING = (
    "the first 60 % of a 1.3 s walk contain only half a stride, so cross-validation "
    "underestimates the error of the rest; with equal weights of short and long movements "
    "in the variance, this coverage is larger, but the standard deviations of held-out "
    "movements are too large"
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
            "right, walking1: flexion": WALKING_FLEXION,
            "left, walking1: flexion": WALKING_FLEXION,
            "left, DJ1: flexion": JUMP_FLEXION,
        },
    ),
    Experiment(
        "flexion-coverage-both-legs",
        "Share of flexion errors within the stated standard deviation, four movements",
        coverage,
        BOTH_KNEES,
        _DATA,
        known_misses={
            "later parts: flexion within 1 sd": SHORT_TRAINING,
            "later parts: flexion within 1.96 sd": SHORT_TRAINING,
        },
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
        known_misses={"right: flexion": EXCHANGED_FLEXION},
    ),
)
