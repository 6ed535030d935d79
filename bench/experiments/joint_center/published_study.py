"""Replication of the published numerical experiment, and tests of two claims of the publication.

Table 1 is compared with its legible digits. The claims are that repetitions of a small rotation
give an accurate mean, and that the distance of the marker from the center hardly matters.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, near
from bench.framework.material import SEEDED
from bench.subjects.planar_arcs import arc_points
from jointfit_daemon.center_of_rotation.planar import equal_step_error, three_frame_center
from jointfit_daemon.center_of_rotation.study import PRINTED, PairMaps, StudySetup, run_study
from jointfit_daemon.tools.report.tables import NEAREST, correlations

if TYPE_CHECKING:
    from pathlib import Path

EXPECTED = {"α–σ": (0.98, 0.81), "r–σ": (1.00, 0.99), "r–α": (0.96, 0.91)}
"""From an independent implementation, at the clip that is nearest to the print."""

REPEATS, TRIALS = 1000, 400
"""Rotations that are averaged, and numbers of such averages."""


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
    """Average 1000 repetitions of three frames, once their centers and once their positions.

    Averaged positions have the error predicted for noise of sigma / sqrt(1000). The mean of the
    centers does not converge at small steps, because their error has no finite variance.
    """
    figures: list[Result] = []
    for step in (10, 20, 30):
        rng = np.random.default_rng(step)
        alpha, radius, sigma = np.deg2rad(step), 0.2, 0.001
        truth = arc_points(alpha * np.arange(3), radius)
        predicted = float(equal_step_error(alpha, sigma / np.sqrt(REPEATS)))
        of_centers, of_positions = [], []
        for _trial in range(TRIALS):
            p = truth + rng.normal(0.0, sigma, (REPEATS, 3, 2))
            of_centers.append(np.linalg.norm(three_frame_center(p).mean(axis=0)))
            of_positions.append(np.linalg.norm(three_frame_center(p.mean(axis=0)[None])[0]))
        rms = float(np.sqrt(np.mean(np.square(of_positions))))
        middle, late = np.quantile(of_centers, (0.5, 0.95)) * 1e3
        figures += [
            Result(f"{step}°: mean of 1000 centers, median error", float(middle), unit="mm"),
            Result(f"{step}°: mean of 1000 centers, 95 % below", float(late), unit="mm"),
            Result(f"{step}°: center of mean positions, RMS error", 1e3 * rms, unit="mm"),
            near(f"{step}°: the same over its prediction", rms / predicted, 1.0, 0.1, ""),
        ]
    return figures


def marker_radius(_: Path) -> list[Result]:
    """Compare the error with its first-order prediction, which does not depend on the radius."""
    figures: list[Result] = []
    for radius_cm in (4, 5, 6, 7, 10, 20):
        rng = np.random.default_rng(radius_cm)
        alpha, sigma = np.deg2rad(60.0), 0.005
        truth = arc_points(alpha * np.arange(3), radius_cm / 100)
        p = truth + rng.normal(0.0, sigma, (200_000, 3, 2))
        rms = float(np.sqrt((three_frame_center(p) ** 2).sum(axis=1).mean()))
        ratio = rms / float(equal_step_error(alpha, sigma))
        limit = 1.2 if radius_cm >= 7 else np.inf
        figures.append(Result(f"{radius_cm} cm: error over its prediction", ratio, limit, unit=""))
    return figures


EXPERIMENTS = (
    Experiment(
        "repeated-small-rotations",
        "Mean of 1000 repetitions of three frames, marker at 20 cm, noise 1 mm",
        repeated_rotations,
        SEEDED,
    ),
    Experiment(
        "marker-radius",
        "Error of three frames by radius, steps of 60°, noise 5 mm, over the prediction",
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
