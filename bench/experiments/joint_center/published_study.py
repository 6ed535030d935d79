"""Replication of the numerical experiment of Akbarifar et al. 2021, and tests of two of its claims.

The computed table 1 is compared with the legible digits of the printed table. The first claim is
that repetitions of a small rotation yield an accurate mean center. The second claim is that the
distance of the marker from the center has little influence on the error.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, near
from bench.framework.material import SEEDED
from jointfit_daemon.center_of_rotation.study import (
    PRINTED,
    RADII_M,
    STEPS_RAD,
    PairMaps,
    StudySetup,
    average_repetitions,
    effect_of_radius,
    run_study,
)
from jointfit_daemon.tools.center_study.tables import NEAREST, correlations

if TYPE_CHECKING:
    from pathlib import Path

EXPECTED = {"α–σ": (0.98, 0.81), "r–σ": (1.00, 0.99), "r–α": (0.96, 0.91)}
"""Correlations between error maps, from an independent implementation. A map shows the error by two
of the quantities noise σ, radius r and rotation angle α. The first number is the correlation of
predicted and analytic errors. The second number is the correlation of analytic errors and errors
found by a grid search. The errors are clipped at the limit with which the correlations are closest
to the publication (`NEAREST`)."""
LARGE_RADIUS_M = 0.07
"""Radius of the marker, m, above which the radius has little influence on the error (noise 5
mm)."""


@cache
def _study() -> list[PairMaps]:
    return run_study(StudySetup())


def table_1(_: Path) -> list[Result]:
    figures: list[Result] = []
    for pair in _study():
        clip, (predicted, grid) = NEAREST[pair.name], EXPECTED[pair.name]
        first, second = correlations(pair, "grid", clip)
        shifted = correlations(pair, "shifted grid", clip)[1]
        at = "raw" if clip is None else f"≤ {100 * clip:g} cm"
        printed = PRINTED[pair.name]
        label = f"{pair.name}, {at}"
        figures += [
            near(f"{label}: prediction–analytic, printed {printed[0]}", first, predicted, 0.03, ""),
            near(f"{label}: analytic–grid, printed {printed[1]}", second, grid, 0.06, ""),
            near(f"{label}: analytic–shifted grid", shifted, grid, 0.06, ""),
        ]
    return figures


def repeated_rotations(_: Path) -> list[Result]:
    """Compare the mean of the centers of all repetitions with the center of the mean positions."""
    found = average_repetitions(StudySetup())
    figures: list[Result] = []
    for step, centers, positions in zip(np.rad2deg(STEPS_RAD), *found, strict=True):
        label = f"{step:.0f}°, median error"
        figures += [
            Result(f"{label}: mean of 1000 centers", 1e3 * centers, unit="mm"),
            Result(f"{label}: center of mean positions", 1e3 * positions, unit="mm"),
        ]
    shortest = float(found.mean_of_centers[0] / found.center_of_means[0])
    return [*figures, Result("10°: ratio of the two errors", shortest, minimum=3.0, unit="")]


def marker_radius(_: Path) -> list[Result]:
    """Compare the errors at small radii with the error at the largest radius."""
    return [
        Result(
            f"{100 * radius:.0f} cm: 95th percentile, relative to the largest radius",
            float(ratio),
            1.2 if radius >= LARGE_RADIUS_M else np.inf,
            unit="",
        )
        for radius, ratio in zip(RADII_M, effect_of_radius(StudySetup()), strict=True)
    ]


EXPERIMENTS = (
    Experiment(
        "repeated-small-rotations",
        "Mean of 1000 repetitions of three frames, setup of the published experiment",
        repeated_rotations,
        SEEDED,
    ),
    Experiment(
        "marker-radius",
        "Error of three frames by radius of the marker, noise 5 mm",
        marker_radius,
        SEEDED,
    ),
    Experiment(
        "published-error-maps",
        "Correlations of error maps: table 1 of the published numerical experiment",
        table_1,
        SEEDED,
        long=True,
    ),
)
