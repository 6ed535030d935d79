"""Every fusion method on twenty simulated subjects with soft-tissue artefact.

Each subject has its own alignment, headings, soft-tissue artefact and sensor errors, with the
default settings of the simulator. The methods are trained on 60 s of four movements, with skin
markers as reference. They are evaluated on 24 s of later movement, when sensor errors and headings
have drifted. The ground truth is the orientation of the simulated bones.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines import fusion_methods
from bench.experiments.fusion.recorded_movements import DEFAULT, NAMES, NOTHING, flexion_scores
from bench.experiments.fusion.simulated_leg import take_pose, wear_live
from bench.framework.experiment import (
    Experiment,
    Result,
    median_and_smallest,
    median_and_worst,
)
from bench.framework.material import simulated_subjects
from bench.subjects.recorded_knee import Judge, KneeTrial
from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration.anatomy import track_clusters
from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from jointfit_daemon.calibration.registration import sensor_at
from jointfit_daemon.fusion import HEADING_SD
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array

SEEDS = tuple(range(1, 21))
SEGMENTS = ("thigh", "shank")
TOLERANCE = 0.05
STRIDE = 4
"""Step between evaluated frames of the live part, because neighbouring frames are correlated."""


@cache
def person(seed: int) -> tuple[KneeTrial, KneeTrial] | None:
    """Return training trial and later trial of a subject; None if its static pose is refused."""
    rig, trials = bench_rig(), phases(seed)
    pose = take_pose(trials.static, rig)
    optical = trials.functional.optical
    if pose is None or optical is None:
        return None
    settings = replace(rig.calibration, method="mean")
    alignment = fit_plate_alignment(trials.align, settings)
    found = fit_calibration(pose, trials.functional, alignment, settings, rig.chain)
    tracks = track_clusters(optical, pose.clusters)
    bones = [rotation.multiply(tracks[name].q, found.segment[name].q_static) for name in SEGMENTS]
    live = wear_live(seed)
    taught: list[Array] = []
    judged: list[Array] = []
    for name, item in found.sensor.items():
        raw = sensor_at(trials.functional.sensors[name], optical.t_ns, item.lag_ns)
        for q, said in ((raw, taught), (np.array(live.said[name]), judged)):
            turned = rotation.multiply(np.array(item.q_optical_world), q)
            said.append(rotation.multiply(turned, np.array(item.q_sensor_segment)))
    seen = np.all([np.isfinite(q).all(axis=1) for q in (*taught, *bones)], axis=0)
    training = _knee([q[seen][::2] for q in (*taught, *bones)])
    later = _knee([q[::STRIDE] for q in (*judged, live.bones["thigh"], live.bones["shank"])])
    phases.cache_clear()
    return training, later


def _knee(columns: list[Array]) -> KneeTrial:
    a, b, c, d, thigh, shank = columns
    return KneeTrial((a, b, c, d), thigh, shank)


def simulated(_: Path, seeds: tuple[int, ...] = SEEDS) -> list[Result]:
    """Measure errors of all methods, and coverage of mean, patent12, linear and anchored."""
    people = [found for seed in seeds if (found := person(seed)) is not None]
    figures = [Result("subjects accepted", len(people), len(seeds), len(seeds) - 2, unit="")]
    errors = {
        method: np.array(
            [
                Judge.of(taught).errors(fusion_methods.fit(method, [taught])(later), later)
                for taught, later in people
            ]
        )
        for method in fusion_methods.METHODS
    }
    rivals = [errors[method] for method in fusion_methods.METHODS[:5]]
    medians, worst = np.median(rivals, axis=1).min(axis=0), np.max(rivals, axis=1).min(axis=0)
    for method, of_method in errors.items():
        for i, name in enumerate(NAMES):
            figures += median_and_worst(
                f"{method}: {name}",
                of_method[:, i].tolist(),
                maximum=round(float(medians[i]), 3) if method == DEFAULT else NOTHING,
                worst_maximum=round(float(worst[i]), 3) if method == DEFAULT else NOTHING,
            )
    return figures + _coverage(people)


def _coverage(people: list[tuple[KneeTrial, KneeTrial]]) -> list[Result]:
    figures = []
    for method in ("mean", "patent12", "linear", DEFAULT):
        scores = [flexion_scores([taught], later, method) for taught, later in people]
        figures += _shares(f"{method}: flexion", scores, held=method == DEFAULT)
    segments = [segment_scores(taught, later) for taught, later in people]
    return figures + _shares(f"{DEFAULT}: segments, errors about each axis", segments, held=True)


def segment_scores(taught: KneeTrial, later: KneeTrial) -> Array:
    """Return the errors about each axis divided by their predicted standard deviations.

    The standard deviations include the uncertainty of the heading.
    """
    scores = []
    for model, part in zip(
        fusion_methods.models([taught]), fusion_methods.segments(later), strict=True
    ):
        said = model.predict(part.sensors, part.other)
        off = rotation.log(rotation.multiply(rotation.conjugate(said), part.bone))
        w, x, y, z = said.T
        up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
        sd = np.hypot(fusion_methods.axis_deviations(model, part), HEADING_SD * up)
        scores.append((off / sd).ravel())
    return np.concatenate(scores)


def _shares(label: str, scores: Sequence[Array], *, held: bool) -> list[Result]:
    """Return the coverage over all frames, and the median and smallest coverage of a subject."""
    tolerance = TOLERANCE if held else NOTHING
    results = []
    for share, within in ((0.68, 1.0), (0.95, 1.96)):
        name = f"{label} within {within:g} sd"
        least, most = round(share - tolerance, 9), round(share + tolerance, 9)
        together = float(np.mean(np.abs(np.concatenate(scores)) < within))
        each = [float(np.mean(np.abs(subject) < within)) for subject in scores]
        results += [
            Result(name, together, most, least, ""),
            *median_and_smallest(name, each, minimum=least),
        ]
    return results


EXPERIMENTS = (
    Experiment(
        "all-methods-simulated-subjects",
        f"Errors of all methods, {len(SEEDS)} simulated subjects with soft-tissue artefact",
        simulated,
        simulated_subjects(len(SEEDS)),
        long=True,
    ),
)
