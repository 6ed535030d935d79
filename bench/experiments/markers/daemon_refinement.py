"""Effect of the daemon's marker refinement on the errors of simulated subjects.

The subjects are calibrated with and without `refine_markers`. For some subjects, one marker of each
segment is displaced between the static pose and the movement. For each subject, the live errors of
the two calibrations are compared. The errors are differences from the simulated bones, so the
cameras affect them only through the calibrations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.fusion.simulated_leg import SEEDS, SEGMENTS, errors_of, take_pose, wear_live
from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import simulated_subjects
from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration.anatomy import track_cluster
from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path

    from bench.experiments.fusion.simulated_leg import Live
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration import CalibrationTrial
    from jointfit_daemon.calibration.phases import PlateAlignment, StaticPose
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration

KNOCKED = {"thigh": "T2", "shank": "C2"}
KNOCKED_M = 0.015
FEW = 4
"""Number of subjects with displaced markers."""
NOTHING = float("inf")
COSTS_NOTHING_DEG = 0.1


def refined(_: Path) -> list[Result]:
    """Measure how refinement changes the live errors, deg; a negative change is an improvement."""
    rig = bench_rig()
    worn: list[Array] = []
    knocked: list[Array] = []
    off_mm: list[Array] = []
    for seed in SEEDS:
        trials, live = phases(seed), wear_live(seed)
        pose = take_pose(trials.static, rig)
        if pose is None:
            continue
        alignment = fit_plate_alignment(trials.align, rig.calibration)

        change, calibration = _change(rig, pose, trials.functional, alignment, live)
        worn.append(change)
        parts = calibration.quality["markers"]["parts"]
        off_mm.append(
            1e3 * np.array([[parts[s]["before_m"], parts[s]["after_m"]] for s in SEGMENTS])
        )
        if len(knocked) < FEW:
            functional = _knocked(trials.functional, pose, seed)
            knocked.append(_change(rig, pose, functional, alignment, live)[0])
        phases.cache_clear()
    before, after = np.mean(off_mm, axis=1).T
    rigid = "distance from a rigid segment"
    return [
        Result("subjects", float(len(worn)), NOTHING, unit=""),
        *median_and_worst(f"{rigid}, static positions", before.tolist(), "mm"),
        *median_and_worst(
            f"{rigid}, refined positions",
            after.tolist(),
            "mm",
            maximum=round(float(np.median(before)), 2),
            worst_maximum=round(float(np.max(before)), 2),
        ),
        *_changes("markers as placed", worn, COSTS_NOTHING_DEG),
        *_changes(f"one marker per segment displaced, {len(knocked)} subjects", knocked, 0.0),
    ]


def _change(
    rig: Rig, pose: StaticPose, functional: CalibrationTrial, alignment: PlateAlignment, live: Live
) -> tuple[Array, Calibration]:
    """Return the change of the errors of knee, thigh and shank by refinement, deg.

    The second result is the calibration with refinement.
    """
    found = [
        fit_calibration(
            pose, functional, alignment, replace(rig.calibration, refine_markers=on), rig.chain
        )
        for on in (False, True)
    ]
    errors = [errors_of(calibration, live) for calibration in found]
    plain, better = (np.array([e.knee, e.thigh, e.shank]) for e in errors)
    return better - plain, found[1]


def _changes(label: str, found: list[Array], goal: float) -> list[Result]:
    table = np.array(found)
    figures = []
    for i, name in enumerate(("knee", *SEGMENTS)):
        title, changes = f"{label}: {name}", table[:, i].tolist()
        figures.append(Result(f"{title}, mean", float(np.mean(changes)), goal))
        figures += median_and_worst(title, changes, maximum=goal, worst_maximum=NOTHING)
    return figures


def _knocked(functional: CalibrationTrial, pose: StaticPose, seed: int) -> CalibrationTrial:
    """Return the movement with one displaced marker on each segment."""
    optical, rng = functional.optical, np.random.default_rng(seed)
    if optical is None:
        return functional
    positions = optical.positions.copy()
    for segment, marker in KNOCKED.items():
        shift = rng.normal(size=3)
        shift *= KNOCKED_M / np.linalg.norm(shift)
        q = track_cluster(optical, pose.clusters[segment]).q
        positions[:, optical.markers.index(marker)] += rotation.rotate(q, shift)
    return replace(functional, optical=replace(optical, positions=positions))


EXPERIMENTS = (
    Experiment(
        "daemon-marker-refinement",
        f"Change of the errors by marker refinement during calibration, {len(SEEDS)} simulated "
        "subjects",
        refined,
        simulated_subjects(len(SEEDS)),
        long=True,
    ),
)
