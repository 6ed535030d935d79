"""Differences of joint angles if six operators place the markers of one subject with errors.

The errors of placement and the noise are simulated. The differences are measured before and after
marker refinement.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.markers.refinement import motion
from bench.framework.experiment import Experiment, Result
from bench.framework.material import SIMULATED_MARKERS
from bench.subjects.adult_lower_limbs import FOLDER, oc4_lower
from jointfit_daemon.calibration.marker_refinement import (
    MotionTrial,
    RefinementSettings,
    refine_markers,
)
from jointfit_daemon.kinematics.chains import marker_positions, step_between
from jointfit_daemon.kinematics.inverse_kinematics import solve_frames
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState

OPERATORS = 6
TEAMS = 5
"""Number of groups of six operators."""
PLACEMENT_M = 0.01
"""Standard deviation of a marker position per axis, m."""
NOISE_M = 0.001
_EVERY = {"walking1": 2, "squats1": 20, "DJ1": 4}
_TRAINED = ("walking1", "squats1")
_UNSEEN = "DJ1"


def _movements(data: Path) -> dict[str, ChainState]:
    """Return the poses of the subject, by movement, from which the markers are simulated."""
    model = oc4_lower(data)
    return {
        name: solve_frames(model, motion(data, name, step).targets).state
        for name, step in _EVERY.items()
    }


def _angle_errors(fitted: ChainModel, truth: ChainState, y: Array) -> Array:
    """Return the errors of all joint angles, rad, shape (T, joints)."""
    return step_between(fitted, truth, solve_frames(fitted, y).state)[:, 6:]


def spread_deg(errors: list[Array]) -> float:
    """Return the standard deviation between operators, RMS over frames and angles, deg."""
    return float(np.degrees(np.sqrt(np.var(errors, axis=0, ddof=1).mean())))


def team(
    model: ChainModel, truly: dict[str, ChainState], seed: int, settings: RefinementSettings
) -> dict[str, tuple[float, float]]:
    """Return the results of one group of six operators: values before and after refinement."""
    rng = np.random.default_rng([61, seed])
    errors: dict[str, tuple[list[Array], list[Array]]] = {name: ([], []) for name in truly}
    tracking, places = [], []
    for _ in range(OPERATORS):
        off = rng.normal(0.0, PLACEMENT_M, model.positions.shape)
        placed = model.with_markers(model.positions + off)
        seen = {
            name: marker_positions(placed, state)
            + rng.normal(0.0, NOISE_M, (len(state), *model.positions.shape))
            for name, state in truly.items()
        }
        trials = [MotionTrial(name, seen[name], 50.0) for name in _TRAINED]
        unseen = [MotionTrial(_UNSEEN, seen[_UNSEEN], 50.0)]
        found = refine_markers(model, trials, settings, unseen)

        for name, state in truly.items():
            for kept, fitted in zip(errors[name], (model, found.model), strict=True):
                kept.append(_angle_errors(fitted, state, seen[name]))
        tracking += [(t.before.rms, t.after.rms) for t in found.trials if not t.trained]
        wrong = found.model.positions - placed.positions
        places.append([np.sqrt((e**2).sum(axis=1).mean()) for e in (off, wrong)])

    before, after = np.mean(places, axis=0)
    old, new = np.mean(tracking, axis=0)
    trained = [float(np.mean([spread_deg(errors[name][k]) for name in _TRAINED])) for k in (0, 1)]
    later = [spread_deg(errors[_UNSEEN][k]) for k in (0, 1)]
    return {
        "marker position error": (MM_PER_M * float(before), MM_PER_M * float(after)),
        "tracking error, unseen movement": (MM_PER_M * float(old), MM_PER_M * float(new)),
        "joint angles between operators, trained movements": (trained[0], trained[1]),
        "joint angles between operators, unseen movement": (later[0], later[1]),
    }


def repeatability(data: Path, teams: int = TEAMS) -> list[Result]:
    """Measure the median over the groups before and after refinement, and the worst change, %."""
    model, truly = oc4_lower(data), _movements(data)
    settings = RefinementSettings()
    found = [team(model, truly, seed, settings) for seed in range(teams)]
    results = []
    for name in found[0]:
        pairs = np.array([figures[name] for figures in found])
        unit = "deg" if "angles" in name else "mm"
        before, after = np.median(pairs, axis=0)
        worst = 100.0 * float((pairs[:, 1] / pairs[:, 0] - 1.0).max())
        results += [
            Result(f"{name}: before, median", float(before), inf, unit=unit),
            Result(f"{name}: after, median", float(after), float(before), unit=unit),
            Result(f"{name}: change, worst team", worst, 0.0, unit="%"),
        ]
    return results


EXPERIMENTS = (
    Experiment(
        "marker-refinement-operators",
        "Repeatability of joint angles if six operators place the markers of one subject "
        "with errors of 10 mm per axis, in five groups",
        repeatability,
        SIMULATED_MARKERS,
        recordings=(FOLDER,),
        long=True,
    ),
)
