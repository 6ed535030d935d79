"""Predicted uncertainty of the default method on both legs of a recorded adult, by movement.

A case is one leg, one reference, and one assignment (deal) of recorded filter errors to the
sensors. The coverage of a case is the share of errors within 1 or 1.96 predicted standard
deviations. It is computed for flexion, and for each segment about all three axes. The standard
deviation of a segment includes the uncertainty of its heading.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.recorded_legs import guided, squats_alone
from bench.experiments.fusion.recorded_movements import NAMES, joint_scores
from bench.framework.experiment import Experiment, Result
from bench.framework.material import RECORDED_LEGS
from bench.subjects.recorded_legs import (
    DEALS,
    FOLDER,
    LEGS,
    MOVEMENTS,
    REFERENCES,
    LegCase,
    recorded_leg,
)
from jointfit_daemon.fusion import HEADING_SD
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from bench.baselines.fusion_methods import SegmentInputs
    from bench.subjects.recorded_knee import KneeTrial
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import SegmentModel

    Trials = dict[str, KneeTrial]
    Training = Callable[[Trials], list[tuple[list[KneeTrial], Trials]]]

WITHIN = (1.96, 1.0)
"""Numbers of predicted standard deviations. The thresholds apply to the first number."""
LEAST, MOST = 0.90, 0.99
"""Target range of the coverage."""
INF = float("inf")


TRAININGS: dict[str, Training] = {
    "later parts": guided,
    "after squats": squats_alone,
}
"""Training sets: the first 60 % of all movements, or the first 60 % of the squats."""


def coverage(data: Path, deals: Sequence[int] = DEALS) -> list[Result]:
    """Measure median and smallest coverage over legs and deals, by movement and for all cases."""
    results: list[Result] = []
    shares: list[Array] = []
    for label, training in TRAININGS.items():
        for reference in REFERENCES:
            cases = [LegCase(leg, deal, reference) for leg in LEGS for deal in deals]
            found = [_shares(data, case, training) for case in cases]
            for movement in MOVEMENTS:
                row = np.array([each[movement] for each in found])
                shares.append(row)
                for k, name in enumerate(NAMES):
                    title = f"{label}, {reference}, {movement}: {name}"
                    results += [
                        Result(title, float(np.median(row[:, 0, k])), INF, LEAST, ""),
                        Result(f"{title}, smallest", float(row[:, 0, k].min()), INF, unit=""),
                    ]
    return results + _all_cases(np.concatenate(shares))


def _all_cases(shares: Array) -> list[Result]:
    """Return statistics of the coverage of all cases and movements, shape (n, 2, 3)."""
    results = []
    for k, name in enumerate(NAMES):
        for i, within in enumerate(WITHIN):
            title = f"all cases: {name} within {within:g} sd"
            results += [
                Result(f"{title}, median", float(np.median(shares[:, i, k])), INF, unit=""),
                Result(f"{title}, smallest", float(shares[:, i, k].min()), INF, unit=""),
            ]
    every = shares[:, 0]
    inside = (every >= LEAST) & (every <= MOST)
    return [
        *results,
        Result(
            "all cases and quantities: share with coverage (1.96 sd) from 0.90 to 0.99",
            float(np.mean(inside)),
            INF,
            unit="",
        ),
        Result(
            "all cases and quantities: share with coverage below 0.90",
            float(np.mean(every < LEAST)),
            INF,
            unit="",
        ),
        Result(
            "all cases and quantities: share with coverage below 0.80",
            float(np.mean(every < 0.8)),
            INF,
            unit="",
        ),
    ]


def _shares(data: Path, case: LegCase, training: Training) -> dict[str, Array]:
    """Return the coverage of both segments and of flexion for every evaluated movement.

    The shape is (2, 3): numbers of standard deviations as in `WITHIN`, names as in `NAMES`.
    """
    trials = {movement: recorded_leg(data, movement, case) for movement in MOVEMENTS}
    shares = {}
    for taught, evaluated in training(trials):
        models = fusion_methods.models(taught)
        alike = fusion_methods.correlation(taught)
        for movement, trial in evaluated.items():
            scores = [
                segment_scores(model, part)
                for model, part in zip(models, fusion_methods.segments(trial), strict=True)
            ]
            scores.append(joint_scores(models, alike, trial))
            shares[movement] = np.array(
                [[np.mean(np.abs(each) < within) for each in scores] for within in WITHIN]
            )
    return shares


def segment_scores(model: SegmentModel, part: SegmentInputs) -> Array:
    """Return the errors about each axis divided by their predicted standard deviations.

    The standard deviations include the uncertainty of the heading.
    """
    said = model.predict(part.sensors, part.other)
    off = rotation.log(rotation.multiply(rotation.conjugate(said), part.bone))
    w, x, y, z = said.T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    sd = np.hypot(fusion_methods.axis_deviations(model, part), HEADING_SD * up)
    scores: Array = (off / sd).ravel()
    return scores


LONG_AXIS = (
    "while the knee is nearly straight, the sensors do not observe the rotation about the "
    "long axis; the two references also differ most in this rotation"
)
SHORT = "the errors in the first 60 % of this movement do not represent the errors in the rest"
APART = (
    "the variance depends only on the distance from the training range; with a larger variance "
    "outside this range, nearly all errors of simulated subjects would be within 1.96 sd"
)
MISSES = {
    "later parts, fitted, walking1: thigh": SHORT,
    "later parts, fitted, walking1: shank": SHORT,
    "later parts, fitted, walking1: flexion": SHORT,
    "later parts, fitted, DJ1: thigh": LONG_AXIS,
    "later parts, fitted, DJ1: shank": LONG_AXIS,
    "later parts, placed, walking1: thigh": SHORT,
    "later parts, placed, walking1: flexion": SHORT,
    "later parts, placed, DJ1: thigh": LONG_AXIS,
    "later parts, placed, DJ1: shank": LONG_AXIS,
    "later parts, placed, DJ1: flexion": SHORT,
    "after squats, placed, walking1: flexion": APART,
}
EXPERIMENTS = (
    Experiment(
        "recorded-legs-coverage",
        "Share of errors within 1.96 stated standard deviations, by movement",
        coverage,
        RECORDED_LEGS,
        (FOLDER,),
        long=True,
        known_misses=MISSES,
    ),
)
