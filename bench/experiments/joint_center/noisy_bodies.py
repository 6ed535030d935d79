"""Joint centers between two bodies with noisy markers: coverage of ellipsoids, and errors."""

from __future__ import annotations

from itertools import product
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result
from bench.framework.material import SEEDED, Material
from bench.subjects.noisy_bodies import Subject
from bench.subjects.simulated_joints import covers
from jointfit_daemon.center_of_rotation import estimate_center
from jointfit_daemon.center_of_rotation.planar import CircleLimits, circle_estimate
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from jointfit_daemon.center_of_rotation import CenterEstimate


SUBJECTS = 8
RUNS = 125
"""Number of runs per subject. The coverage of 1000 runs has a standard error of 0.7 %."""
METHOD_RUNS = 50
"""Number of runs per subject for the comparison of methods."""
ARTEFACT_RUNS = 25
"""Number of runs per subject with soft-tissue artefact."""
ANGLES_DEG = (20.0, 45.0, 90.0)
WORST_PERCENT = 87.0
"""Threshold for the subject with the smallest coverage: 4 standard errors below 95 % for 125 runs.
"""


def estimates(
    rom: float, markers: int, errors: tuple[float, float], runs: int, method: str = "auto"
) -> list[list[CenterEstimate]]:
    """Return the estimates of every run, one list per subject.

    The values in `errors` are the noise and the soft-tissue artefact, m.
    """
    found = []
    for number in range(SUBJECTS):
        rng = np.random.default_rng([16, number, markers])
        subject = Subject.random(rng, markers)
        trials = (subject.observe(rng, rom, *errors) for _ in range(runs))
        found.append([estimate_center(trial, method) for trial in trials])
    return found


def rms_mm(found: Iterable[CenterEstimate]) -> float:
    return MM_PER_M * float(np.sqrt(np.mean([e.center @ e.center for e in found])))


def held_percent(found: Iterable[CenterEstimate]) -> float:
    return 100.0 * float(np.mean([e.refused is None and covers(e) for e in found]))


def measure_noise(runs: int) -> list[Result]:
    """Measure the coverage of all runs and of the worst subject, and the RMS errors.

    A rejected estimate counts as not covered.
    """
    results = []
    for rom, markers, noise in product(ANGLES_DEG, (3, 4), (0.5e-3, 1e-3, 2e-3)):
        people = estimates(rom, markers, (noise, 0.0), runs)
        label = f"{rom:g}°, {markers} markers, noise {MM_PER_M * noise:g} mm"
        together = [e for person in people for e in person]
        held = [held_percent(person) for person in people]
        errors = [rms_mm(person) for person in people]
        results += [
            Result(f"{label}: coverage", held_percent(together), 97.0, 93.0, "%"),
            Result(f"{label}: coverage, worst subject", min(held), inf, WORST_PERCENT, "%"),
            Result(f"{label}: RMS error, median", float(np.median(errors)), inf, unit="mm"),
            Result(f"{label}: RMS error, worst subject", max(errors), inf, unit="mm"),
        ]
    return results


def compare_methods(runs: int) -> list[Result]:
    """Compare the default method with other methods on the same runs, with a noise of 1 mm."""
    results = []
    for rom, method in product(ANGLES_DEG, ("score", "sphere", "halvorsen")):
        people = estimates(rom, 4, (1e-3, 0.0), runs, method)
        known = [[e for e in person if np.isfinite(e.center).all()] for person in people]
        errors = [rms_mm(person) for person in known if person]
        refused = [e.refused is not None for person in people for e in person]
        label = f"{rom:g}°, {method}"
        results += [
            Result(f"{label}: RMS error, median", float(np.median(errors)), inf, unit="mm"),
            Result(f"{label}: RMS error, worst subject", max(errors), inf, unit="mm"),
            Result(f"{label}: rejected", 100.0 * float(np.mean(refused)), inf, unit="%"),
        ]
    return results


def measure_soft_tissue(runs: int) -> list[Result]:
    """Measure the coverage of accepted centers with soft-tissue artefact and a noise of 0.3 mm."""
    results = []
    for rom, markers, soft_tissue in product(ANGLES_DEG, (3, 4), (1e-3, 3e-3)):
        people = estimates(rom, markers, (3e-4, soft_tissue), runs)
        label = f"{rom:g}°, {markers} markers, artefact {MM_PER_M * soft_tissue:g} mm"
        used = [[e for e in person if e.refused is None] for person in people]
        errors = [rms_mm(person) for person in used if person]
        rejected = 100.0 * (1.0 - sum(map(len, used)) / sum(map(len, people)))
        results.append(Result(f"{label}: rejected", rejected, inf, unit="%"))
        if errors:
            held = [held_percent(person) for person in used if person]
            results += [
                Result(f"{label}: coverage, worst subject", min(held), inf, 93.0, "%"),
                Result(f"{label}: RMS error, median", float(np.median(errors)), inf, unit="mm"),
                Result(f"{label}: RMS error, worst subject", max(errors), inf, unit="mm"),
            ]
    return results


def measure_gate(runs: int) -> list[Result]:
    """Measure how a limit of the predicted error changes coverage and bias of accepted circles.

    The circles have one marker, an arc of 30° and a noise of 2 mm.
    """
    rng = np.random.default_rng(20)
    theta = np.linspace(0.0, np.radians(30.0), 100)
    exact = 0.3 * np.stack((np.cos(theta), np.sin(theta)), axis=1)
    trials = [exact + rng.normal(0.0, 2e-3, exact.shape) for _ in range(runs)]
    results = []
    for label, limit in (("without limit", inf), ("limit of 20 mm", 0.02)):
        found = [circle_estimate(points, limits=CircleLimits(rms_error=limit)) for points in trials]
        used = [e for e in found if e.refused is None]
        rejected = 100.0 * (1.0 - len(used) / runs)
        outward = MM_PER_M * float(np.mean([e.center[0] for e in used]))
        bounds = (97.0, 93.0) if limit == inf else (inf, -inf)
        results += [
            Result(f"{label}: rejected", rejected, inf, unit="%"),
            Result(f"{label}: coverage", held_percent(used), *bounds, "%"),
            Result(f"{label}: mean error along the radius", outward, inf, unit="mm"),
        ]
    return results


def _noise(_: Path) -> list[Result]:
    return measure_noise(RUNS)


def _methods(_: Path) -> list[Result]:
    return compare_methods(METHOD_RUNS)


def _soft_tissue(_: Path) -> list[Result]:
    return measure_soft_tissue(ARTEFACT_RUNS)


def _gate(_: Path) -> list[Result]:
    return measure_gate(4000)


def _drawn(runs: int) -> Material:
    """Return the material of the simulated subjects with a number of runs each."""
    subjects = f"{SUBJECTS} simulated subjects with different markers, {runs} runs each"
    return SEEDED._replace(subjects=subjects)


EXPERIMENTS = (
    Experiment(
        "noisy-bodies-coverage",
        "Coverage of 95 % ellipsoids: two noisy bodies, clusters 8 cm wide, 20 cm from the joint",
        _noise,
        _drawn(RUNS),
        long=True,
    ),
    Experiment(
        "noisy-bodies-methods",
        "Two noisy bodies, noise 1 mm, four markers each: the default (score) and other methods",
        _methods,
        _drawn(METHOD_RUNS),
        long=True,
    ),
    Experiment(
        "noisy-bodies-soft-tissue",
        "Two noisy bodies with soft-tissue artefact, noise 0.3 mm",
        _soft_tissue,
        _drawn(ARTEFACT_RUNS),
        long=True,
    ),
    Experiment(
        "circle-error-limit",
        "Effect of a limit of the predicted error: one marker, arc of 30°, noise 2 mm, 4000 runs",
        _gate,
        SEEDED,
    ),
)
