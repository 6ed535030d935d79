"""Errors of the knee rotation, and segment errors divided by their predicted standard deviation.

Invariant: recordings, training and hold-out are the same as in `knee_segments`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.knee_segments import Squats
from bench.framework.experiment import Experiment, Result
from bench.framework.material import KNEE
from bench.subjects.recorded_knee import FOLDER, load
from jointfit_daemon.calibration.soft_tissue import BLOCKS, SegmentTraining, fit_expert
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import joint_rotation
from jointfit_daemon.limb_model import fuse

if TYPE_CHECKING:
    from pathlib import Path

    from bench.subjects.recorded_knee import KneeTrial
    from jointfit_daemon.arrays import Array

JOINT_GOALS = {"hold-out": 1.2, "walking": 3.0, "drop jump": 4.3}
NORMALIZED = (0.5, 1.3)
EQUAL = (0.5, 0.5)
ROTATIONS = 3
"""Number of rotations that are regressors of the joint fit: the joint rotation from the sensor
means, and for each segment the rotation between its two sensors."""


def joint_itself(data: Path) -> list[Result]:
    """Measure the RMS error of the knee rotation, computed in two ways.

    The first way computes the rotation from the fused orientations of thigh and shank. The second
    way is a joint fit: a regression that corrects the knee rotation itself. The knee of the
    reference is a hinge, so adduction and rotation are functions of flexion. The joint fit learns
    these functions, which a real knee does not have.
    """
    squats = Squats(data)
    judged = {
        "hold-out": squats.held,
        "walking": load(data, "walking1"),
        "drop jump": load(data, "DJ1"),
    }
    segments = fusion_methods.fit("anchored", [squats.training])
    u, seen, truth = _joint(squats.training)
    training = SegmentTraining.of(squats.training.sensors[:2], None, truth)
    rho = rotation.log(rotation.multiply(rotation.conjugate(seen), truth))
    alone = fit_expert(
        u, rho, ROTATIONS, [list(training.folds(BLOCKS))], np.ones(len(u)), tilted=False
    ).expert
    figures = []
    for name, trial in judged.items():
        u, seen, truth = _joint(trial)
        said = rotation.multiply(seen, rotation.exp(alone.correct(u, ROTATIONS)[0]))
        both = joint_rotation(*segments(trial))
        figures += [
            Result(f"{name}: both segments", _rms_degrees(both, truth), float("inf")),
            Result(f"{name}: joint alone", _rms_degrees(said, truth), JOINT_GOALS[name]),
        ]
    return figures


def normalized_errors(data: Path) -> list[Result]:
    """Measure the RMS ratio of segment error to predicted standard deviation, three movements."""
    squats = Squats(data)
    walk, jump = load(data, "walking1"), load(data, "DJ1")
    models = fusion_methods.models([squats.training, walk, jump])
    ratios: list[list[Array]] = [[], []]
    for trial in (squats.held, walk, jump):
        truths = (trial.thigh, trial.shank)
        for i, segment in enumerate(fusion_methods.segments(trial)):
            said = models[i].predict(segment.sensors, segment.other)
            claimed = fusion_methods.axis_deviations(models[i], segment)
            squares = rotation.angle_between(said, truths[i]) ** 2
            ratios[i].append(squares / np.sum(claimed**2, axis=1))
    low, high = NORMALIZED
    return [
        Result(name, float(np.sqrt(np.mean(np.concatenate(found)))), high, low, unit="")
        for name, found in zip(("thigh", "shank"), ratios, strict=True)
    ]


def _joint(trial: KneeTrial) -> tuple[Array, Array, Array]:
    """Return the regressors of the joint fit, shape (n, 9), and two knee rotations, shape (n, 4).

    The first rotation is between the sensor means, the second between the reference orientations.
    """
    a, b, c, d = trial.sensors
    seen = joint_rotation(fuse([a, b], EQUAL), fuse([c, d], EQUAL))
    pairs = [rotation.log(joint_rotation(*pair)) for pair in ((a, b), (c, d))]
    u = np.concatenate([rotation.log(seen), *pairs], axis=1)
    return u, seen, joint_rotation(trial.thigh, trial.shank)


def _rms_degrees(said: Array, truth: Array) -> float:
    return float(np.rad2deg(np.sqrt(np.mean(rotation.angle_between(said, truth) ** 2))))


_DATA = (FOLDER,)
EXPERIMENTS = (
    Experiment(
        "knee-joint-rotation",
        "Error of the knee rotation from both segments, and from a fit to the joint alone",
        joint_itself,
        KNEE,
        _DATA,
    ),
    Experiment(
        "knee-normalized-errors",
        "RMS of the ratio of the error to its stated standard deviation, three trained movements",
        normalized_errors,
        KNEE,
        _DATA,
    ),
)
