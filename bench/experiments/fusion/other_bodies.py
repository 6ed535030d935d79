"""Simulated subjects that were not used in development, with other bones and soft tissue.

No other experiment uses these seeds. Bone lengths, hip positions, sensor orientations on the
segments and magnitudes of the soft-tissue artefact are random for every subject.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.fusion.simulated_leg import (
    KNEE_GOAL_DEG,
    Errors,
    errors_of,
    live_of,
    take_pose,
)
from bench.framework.experiment import (
    Experiment,
    Result,
    median_and_smallest,
    median_and_worst,
)
from bench.framework.material import simulated_subjects
from bench.subjects.simulated_wearer import bench_rig, phases_of
from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from jointfit_daemon.units import MM_PER_M
from jointfit_simulators.body import LegGeometry
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.limb_model import Method

SEEDS = tuple(range(9001, 9007))
METHODS: tuple[Method, ...] = ("anchored", "mean")


def drawn_body(seed: int) -> tuple[Knobs, LegGeometry]:
    """Draw random bones and error magnitudes for one subject."""
    rng = np.random.default_rng(seed)
    geometry = LegGeometry(
        thigh_m=rng.uniform(0.35, 0.50),
        shank_m=rng.uniform(0.33, 0.46),
        hip_in_pelvis=(
            rng.uniform(0.075, 0.105),
            rng.uniform(0.0, 0.04),
            rng.uniform(-0.09, -0.05),
        ),
    )
    knobs = Knobs(
        seed=seed,
        mount_deg=60.0,
        soft_tissue_common_deg=rng.uniform(3.0, 7.0),
        soft_tissue_sensor_deg=rng.uniform(2.0, 4.5),
        marker_soft_tissue_mm=rng.uniform(3.5, 6.5),
    )
    return knobs, geometry


def other_bodies(_: Path) -> list[Result]:
    """Measure errors of the methods anchored and mean, and of the calibrated segment lengths."""
    rig = bench_rig()
    found: dict[Method, list[Errors]] = {method: [] for method in METHODS}
    off_mm = []
    for seed in SEEDS:
        knobs, geometry = drawn_body(seed)
        trials, live = phases_of(knobs, geometry=geometry), live_of(knobs, geometry)
        alignment = fit_plate_alignment(trials.align, rig.calibration)
        pose = take_pose(trials.static, rig)
        if pose is None:
            continue
        fits = {
            method: fit_calibration(
                pose,
                trials.functional,
                alignment,
                replace(rig.calibration, method=method),
                rig.chain,
            )
            for method in METHODS
        }
        for method, calibration in fits.items():
            found[method].append(errors_of(calibration, live))
        for name, truth in (("thigh", geometry.thigh_m), ("shank", geometry.shank_m)):
            length = fits["anchored"].segment[name].length
            off_mm.append(inf if length is None else MM_PER_M * abs(length - truth))

    errors, means = found["anchored"], found["mean"]
    figures = [Result("subjects accepted", len(errors), len(SEEDS), len(SEEDS) - 1, unit="")]
    for name in ("thigh", "shank"):
        figures += median_and_worst(name, [getattr(each, name) for each in errors])
    median, of_mean = (float(np.median([e.knee for e in each])) for each in (errors, means))
    within = [each.within_2_sd for each in errors]
    return [
        *figures,
        Result("knee, median", median, KNEE_GOAL_DEG),
        Result("knee, worst", max(each.knee for each in errors), inf),
        Result("knee, median, method mean", of_mean, inf, minimum=median),
        *median_and_smallest("knee within 2 sd (ideal 0.95)", within, minimum=0.9),
        *median_and_worst("error of a segment length", off_mm, "mm"),
    ]


EXPERIMENTS = (
    Experiment(
        "simulated-leg-other-bodies",
        f"{len(SEEDS)} simulated subjects with other bone lengths, sensor orientations and "
        "soft-tissue artefact",
        other_bodies,
        simulated_subjects(len(SEEDS)),
        long=True,
    ),
)
