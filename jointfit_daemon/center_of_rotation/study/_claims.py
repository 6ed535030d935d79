"""Tests of two claims that the source of the study makes about three-frame centers.

The source (Akbarifar et al. 2021) recommends repeating movements with small angles α and averaging
the results. It also states that the distance r of the marker has an effect only if the noise is
large relative to r.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.center_of_rotation.planar import three_frame_center
from jointfit_daemon.center_of_rotation.study._comparison import compare_methods

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation.study._circle_study import StudySetup

STEPS_RAD = np.deg2rad([10.0, 20.0, 30.0, 45.0])
"""Angles α at which repetitions are averaged, rad."""
RADII_M = np.array([0.03, 0.04, 0.06, 0.07, 0.08, 0.1, 0.2])
"""Distances r of the marker from the center, m."""
LARGE_NOISE_M = 0.005
"""Noise in the runs with varied radius, m, which is the largest noise in the source."""
_BLOCKS = 40
_RUNS = 40_000


class Repetition(NamedTuple):
    """Median error of two ways to average repetitions, by α, m, shape (len(STEPS_RAD),)."""

    mean_of_centers: Array
    """Error if the center is computed in every repetition, and the centers are averaged."""
    center_of_means: Array
    """Error if the marker positions are averaged over the repetitions, and the center is computed
    once.
    """


def average_repetitions(setup: StudySetup) -> Repetition:
    """Return the median errors, over 40 simulations, of averages of `setup.repeats` repetitions."""
    rng = np.random.default_rng(setup.seed)
    found = []
    for step in STEPS_RAD:
        true = _on_circle(setup.radius, step)
        drawn = rng.normal(0.0, setup.noise, (_BLOCKS, setup.repeats, 3, 2))
        centers = three_frame_center(true + drawn).mean(axis=1)
        once = three_frame_center(true + drawn.mean(axis=1))
        found.append([np.median(np.linalg.norm(x, axis=-1)) for x in (centers, once)])
    return Repetition(*np.array(found).T)


def effect_of_radius(setup: StudySetup) -> Array:
    """Return the error at each of `RADII_M` divided by the error at the largest radius of `setup`.

    The error is the 95th percentile, because the mean square is not finite. The noise is
    `LARGE_NOISE_M`, and the angle between frames is `setup.step`.
    """
    rng = np.random.default_rng(setup.seed)
    drawn = rng.normal(0.0, LARGE_NOISE_M, (_RUNS, 3, 2))
    radii = [*RADII_M, float(setup.radii[-1])]
    errors = [
        np.linalg.norm(three_frame_center(_on_circle(r, setup.step) + drawn), axis=-1)
        for r in radii
    ]
    high = np.quantile(errors, 0.95, axis=1)
    return np.asarray(high[:-1] / high[-1])


class StudyExtension(NamedTuple):
    """Results that the source of the study does not contain."""

    median_errors: Mapping[str, Array]
    """Median errors of `compare_methods`, m, by method."""
    repetition: Repetition
    radius_effect: Array


def extend_study(setup: StudySetup) -> StudyExtension:
    """Compare the three-frame solution with geometric methods, and test the two claims."""
    return StudyExtension(
        compare_methods(setup), average_repetitions(setup), effect_of_radius(setup)
    )


def _on_circle(radius: float, step: float) -> Array:
    angles = step * np.arange(3.0)
    return radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
