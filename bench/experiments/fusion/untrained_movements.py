"""Movements of simulated subjects that are not part of the training.

The subjects are simulated as in `simulated_subjects`, with seeds that no other experiment uses. The
models are trained on one movement, a quarter of the functional trial. They are evaluated on the
other movements of the later trial. The ground truth is the orientation of the simulated bones.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.recorded_movements import DEFAULT, flexion_scores
from bench.experiments.fusion.simulated_leg import LIVE
from bench.experiments.fusion.simulated_subjects import person, segment_scores
from bench.framework.experiment import (
    Experiment,
    Result,
    median_and_smallest,
    median_and_worst,
)
from bench.framework.material import simulated_subjects
from bench.subjects.recorded_knee import Judge
from bench.subjects.simulated_wearer import MOVES

if TYPE_CHECKING:
    from pathlib import Path

    from bench.subjects.recorded_knee import KneeTrial

SEEDS = tuple(range(301, 313))
TRAINED = ("walk", "squat")
"""Training movements. For each of them, models are trained on this movement alone."""
WORDS = {"walk": "walking", "squat": "squats", "sit_to_stand": "sit-to-stand"}
"""Name of each movement in results."""
LIVES = [name for name, _ in LIVE]
"""Movements of the later trial, in order of time; all have the same duration."""
LEAST = 0.90
"""Threshold for the share of errors within 1.96 stated standard deviations, median of subjects."""


def untrained(_: Path, seeds: tuple[int, ...] = SEEDS) -> list[Result]:
    """Measure errors and coverage in movements that are not part of the training."""
    people = [found for seed in seeds if (found := person(seed)) is not None]
    figures = [Result("subjects accepted", len(people), len(seeds), len(seeds) - 2, unit="")]
    for trained in TRAINED:
        for movement, words in WORDS.items():
            if movement == trained:
                continue
            cases = [
                (_movement(taught, list(MOVES["leg"]), trained), _movement(later, LIVES, movement))
                for taught, later in people
            ]
            figures += _results(f"after {WORDS[trained]}, {words}", cases)
    return figures


def _movement(trial: KneeTrial, movements: list[str], name: str) -> KneeTrial:
    """Return the frames of one of the movements, which have equal numbers of frames."""
    count = len(trial) // len(movements)
    begin = movements.index(name) * count
    return trial.part(slice(begin, begin + count))


def _results(title: str, cases: list[tuple[KneeTrial, KneeTrial]]) -> list[Result]:
    """Return flexion errors of the methods mean and anchored, and the coverage of anchored."""
    figures = []
    for method in ("mean", DEFAULT):
        errors = [
            Judge.of(taught).errors(fusion_methods.fit(method, [taught])(later), later)[2]
            for taught, later in cases
        ]
        figures += median_and_worst(f"{title}: flexion, {method}", errors, maximum=inf)
    scores = {
        "flexion": [flexion_scores([taught], later) for taught, later in cases],
        "segments, errors about each axis,": [
            segment_scores(taught, later) for taught, later in cases
        ],
    }
    for name, of_subjects in scores.items():
        shares = [float(np.mean(np.abs(each) < 1.96)) for each in of_subjects]
        figures += median_and_smallest(f"{title}: {name} within 1.96 sd", shares, minimum=LEAST)
    return figures


EXPERIMENTS = (
    Experiment(
        "simulated-untrained-movements",
        "Errors and share within the stated standard deviation in movements that are not part of "
        "the training",
        untrained,
        simulated_subjects(len(SEEDS)),
        long=True,
    ),
)
