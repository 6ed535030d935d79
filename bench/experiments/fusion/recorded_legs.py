"""Every fusion method on both legs of a recorded adult, by movement, with two references.

A column is the median error over eight deals of filter errors, of one segment or of flexion, for
one leg, movement, training and reference. The default method must be the best in every column, or
within `MARGIN_DEG` of the best.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.recorded_movements import DEFAULT, NAMES
from bench.framework.experiment import Experiment, Result
from bench.framework.material import RECORDED_LEGS
from bench.subjects.recorded_knee import Judge, training_frames
from bench.subjects.recorded_legs import (
    DEALS,
    FOLDER,
    LEGS,
    MOVEMENTS,
    REFERENCES,
    LegCase,
    recorded_leg,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from bench.subjects.recorded_knee import KneeTrial

    Trials = dict[str, KneeTrial]
    Training = Callable[[Trials], list[tuple[list[KneeTrial], Trials]]]

MARGIN_DEG = 0.1
RIVALS = ("single", "mean", "markley", "patent6", "patent12")


def guided(trials: Trials) -> list[tuple[list[KneeTrial], Trials]]:
    """Return the first 60 % of all movements for training, and the rest of each."""
    training, rest = [], {}
    for movement, trial in trials.items():
        count = training_frames(trial)
        training.append(trial.part(slice(0, count)))
        rest[movement] = trial.part(slice(count, None))
    return [(training, rest)]


def squats_alone(trials: Trials) -> list[tuple[list[KneeTrial], Trials]]:
    """Return the first 60 % of the squats for training; the rest of them and the others."""
    squats = trials["squats1"]
    count = training_frames(squats)
    return [([squats.part(slice(0, count))], trials | {"squats1": squats.part(slice(count, None))})]


def columns(data: Path, training: Training, deals: Sequence[int] = DEALS) -> list[Result]:
    """Return the median over `deals` of the default's error in every column.

    The threshold is the smallest median of the other methods plus `MARGIN_DEG`.
    """
    results = []
    for reference in REFERENCES:
        for leg in LEGS:
            found = [_errors(data, LegCase(leg, deal, reference), training) for deal in deals]
            for movement in MOVEMENTS:
                for k, name in enumerate(NAMES):
                    draws = {
                        method: [errors[movement, method][k] for errors in found]
                        for method in (*RIVALS, DEFAULT)
                    }
                    results.append(_column(f"{reference}, {leg}, {movement}: {name}", draws))
    return results


def _column(name: str, draws: dict[str, list[float]]) -> Result:
    medians = {method: float(np.median(errors)) for method, errors in draws.items()}
    best = min(RIVALS, key=medians.__getitem__)
    return Result(
        name,
        medians[DEFAULT],
        round(medians[best] + MARGIN_DEG, 3),
        note=f"worst {max(draws[DEFAULT]):.2f}; {best} {medians[best]:.2f}",
    )


def _errors(
    data: Path, case: LegCase, training: Training
) -> dict[tuple[str, str], tuple[float, float, float]]:
    """Return the errors by movement and method."""
    trials = {movement: recorded_leg(data, movement, case) for movement in MOVEMENTS}
    judge = Judge.of(trials["squats1"])
    errors = {}
    for taught, evaluated in training(trials):
        for method in (*RIVALS, DEFAULT):
            predict = fusion_methods.fit(method, taught)
            for movement, trial in evaluated.items():
                errors[movement, method] = judge.errors(predict(trial), trial)
    return errors


def _experiment(
    name: str, title: str, training: Training, misses: Sequence[str], reason: str
) -> Experiment:
    return Experiment(
        name,
        title,
        partial(columns, training=training),
        RECORDED_LEGS,
        (FOLDER,),
        long=True,
        known_misses=dict.fromkeys(misses, reason),
    )


AFTER_SQUATS = (
    "fitted, right, STS1: flexion",
    "fitted, left, walking1: flexion",
    "fitted, left, DJ1: thigh",
    "fitted, left, DJ1: shank",
    "placed, right, STS1: flexion",
    "placed, left, walking1: shank",
    "placed, left, walking1: flexion",
    "placed, left, DJ1: shank",
)
UNTRAINED = "the correction extrapolates from squats; the training does not show the error there"
LATER_PARTS = (
    "fitted, left, DJ1: thigh",
    "fitted, left, DJ1: shank",
    "placed, right, walking1: thigh",
    "placed, right, walking1: shank",
    "placed, right, walking1: flexion",
    "placed, right, DJ1: thigh",
    "placed, right, DJ1: shank",
    "placed, right, DJ1: flexion",
    "placed, left, walking1: flexion",
    "placed, left, DJ1: thigh",
    "placed, left, DJ1: shank",
)
HALF_A_MOVEMENT = (
    "the first 60 % of the walk and of the jump contain only the beginning of the movement"
)
EXPERIMENTS = (
    _experiment(
        "recorded-legs-later-parts",
        "Trained on the first 60 % of four movements, later parts of each",
        guided,
        LATER_PARTS,
        HALF_A_MOVEMENT,
    ),
    _experiment(
        "recorded-legs-after-squats",
        "Trained on the first 60 % of the squats alone, four movements",
        squats_alone,
        AFTER_SQUATS,
        UNTRAINED,
    ),
)
