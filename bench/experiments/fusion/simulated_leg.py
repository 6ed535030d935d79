"""Calibration and live estimation of simulated subjects, without wire formats.

Each seed is another subject with its own alignment, headings, soft-tissue artefact and sensor
errors, with the default settings of the simulator. The calibration receives skin markers as its
reference; the evaluation compares its results with the simulated bones. The calibration uses 60 s
(joint circles, walking, squats, sit-to-stand). The evaluation uses 24 s of later movement, the live
part. "Without wire formats" means that the orientations do not pass through codecs and drivers.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import (
    Experiment,
    Result,
    median_and_smallest,
    median_and_worst,
)
from bench.framework.material import simulated_subjects
from bench.subjects.simulated_wearer import Phases, bench_rig, phases
from jointfit_daemon.calibration import CalibrationError, CalibrationTrial, SensorTrack
from jointfit_daemon.calibration.phases import (
    StaticPose,
    fit_calibration,
    fit_plate_alignment,
    fit_static,
)
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import SENSORS, SimulatedSubject, Step, to_wxyz
from jointfit_simulators.devices import Cameras, OrientationSensor
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration, Method
    from jointfit_daemon.model import LimbState, Quaternion
    from jointfit_simulators.body import LegGeometry

SEEDS = tuple(range(1, 9))
"""Seeds of the subjects. The first subject is the subject of the demo."""
METHODS: tuple[Method, ...] = ("anchored", "patent12", "patent6", "mean")
SEGMENTS = ("thigh", "shank")
BEGIN_S = 100.0
"""Start of the live part, s. Errors and soft-tissue artefact change with time, so the live part is
later than the calibration."""
LIVE = (("walk", 8.0), ("squat", 8.0), ("sit_to_stand", 8.0))
RATE_HZ = 50.0
KNEE_GOAL_DEG = 3.0
_STILL_S = np.arange(3.0, 8.0, 0.1)  # standing subject


@dataclass(frozen=True, slots=True)
class Live:
    """Sensors and bones of one subject in motion, in the optical world."""

    t_ns: list[int]
    said: dict[str, list[Quaternion]]
    bones: dict[str, Array]
    """Orientation q_optical_segment by segment, shape (n, 4)."""
    flexion: Array
    """Knee flexion, rad, shape (n,)."""
    standing_m: dict[str, Array]
    """Joint centers in the static pose, m, shape (3,), by joint."""


@dataclass(slots=True)
class Errors:
    """Errors of one method on one subject: RMS errors, deg, coverage, and errors of centers, mm."""

    knee: float = 0.0
    thigh: float = 0.0
    shank: float = 0.0
    within_1_sd: float = 0.0
    within_2_sd: float = 0.0
    centers_mm: dict[str, float] = field(default_factory=dict)


def wear_live(seed: int) -> Live:
    return live_of(Knobs(seed=seed))


def live_of(knobs: Knobs, geometry: LegGeometry | None = None) -> Live:
    """Return the live part of a subject with the given error settings and bones."""
    still = SimulatedSubject(knobs, [Step("stand", 9.0)], geometry=geometry).observe(
        [np.empty(0)] * 4, np.empty(0), _STILL_S
    )
    steps = [Step("stand", BEGIN_S), *(Step(*motion) for motion in LIVE)]
    wearer = SimulatedSubject(knobs, steps, geometry=geometry)
    end_s = BEGIN_S + sum(seconds for _, seconds in LIVE)
    t_s = np.arange(BEGIN_S, end_s, 1 / RATE_HZ)
    seen = wearer.observe([t_s] * len(SENSORS), np.empty(0), t_s)
    said = {
        name: [
            (w, x, y, z) for w, x, y, z in OrientationSensor(knobs, name).report(t_s, q).tolist()
        ]
        for name, q in zip(SENSORS, seen.sensors, strict=True)
    }
    world = Cameras(knobs, wearer, rate_hz=knobs.mocap_hz).world
    return Live(
        np.round(t_s * NS_PER_S).astype(int).tolist(),
        said,
        {name: to_wxyz(world * seen.truth.orientations[name]) for name in SEGMENTS},
        seen.truth.angles[:, 0],
        {name: world.apply(center.mean(axis=0)) for name, center in still.truth.joints.items()},
    )


def _states(calibration: Calibration, live: Live) -> list[LimbState]:
    fuser = LimbFuser(bench_rig().chain, calibration)
    return [
        fuser.fuse(t_ns, t_ns, i, {name: q[i] for name, q in live.said.items()})
        for i, t_ns in enumerate(live.t_ns)
    ]


def errors_of(calibration: Calibration, live: Live) -> Errors:
    states = _states(calibration, live)
    knee = [state.joints[1] for state in states]
    flexion = np.array([joint.angles.flexion if joint.angles else np.nan for joint in knee])
    sd = np.array([joint.angle_sd or np.nan for joint in knee])
    off = flexion - live.flexion
    rms = {
        name: _rms_deg(
            rotation.angle_between(
                np.array([state.segments[i].q_world_segment for state in states]), live.bones[name]
            )
        )
        for i, name in enumerate(SEGMENTS)
    }
    centers = {
        name: 1e3 * float(np.linalg.norm(np.array(joint.center) - live.standing_m[name]))
        for name, joint in calibration.joint.items()
        if joint.center is not None
    }
    return Errors(
        _rms_deg(off),
        rms["thigh"],
        rms["shank"],
        float(np.mean(np.abs(off) < sd)),
        float(np.mean(np.abs(off) < 2 * sd)),
        centers,
    )


def _rms_deg(angles: Array) -> float:
    return float(np.rad2deg(np.sqrt(np.mean(np.square(angles)))))


@cache
def people(method: Method, seeds: tuple[int, ...] = SEEDS) -> list[Errors]:
    """Return the errors of a method on the subjects with an accepted static pose, by seed."""
    rig = bench_rig()
    settings = replace(rig.calibration, method=method)
    found = []
    for seed in seeds:
        trials, live = _worn(seed)
        alignment = fit_plate_alignment(trials.align, rig.calibration)
        pose = take_pose(trials.static, rig)
        if pose is not None:
            calibration = fit_calibration(pose, trials.functional, alignment, settings, rig.chain)
            found.append(errors_of(calibration, live))
    return found


@cache
def _worn(seed: int) -> tuple[Phases, Live]:
    return phases(seed), wear_live(seed)


def take_pose(static: CalibrationTrial, rig: Rig) -> StaticPose | None:
    """Return the accepted static pose; None if the daemon would request another pose."""
    until_ns = min(int(track.t_ns[0]) for track in static.sensors.values())
    until_ns += round(rig.calibration.static_s * NS_PER_S)
    optical = static.optical
    if optical is None:
        return None
    shot = optical.t_ns < until_ns
    asked = CalibrationTrial(
        {
            name: SensorTrack(track.t_ns[now], track.q_world_sensor[now])
            for name, track in static.sensors.items()
            if (now := track.t_ns < until_ns).any()
        },
        replace(
            optical,
            t_ns=optical.t_ns[shot],
            positions=optical.positions[shot],
            body_positions=optical.body_positions[shot],
            body_orientations=optical.body_orientations[shot],
        ),
    )
    try:
        return fit_static(asked, rig.calibration, rig.chain)
    except CalibrationError as refusal:
        print(f"SIM: {refusal}", file=sys.stderr)
        return None


def _row(method: Method) -> Callable[[Path], list[Result]]:
    def run(_: Path) -> list[Result]:
        errors = people(method)
        goal = KNEE_GOAL_DEG if method == "anchored" else float("inf")
        figures = [
            Result("subjects accepted", float(len(errors)), len(SEEDS), len(SEEDS) - 1, unit=""),
            Result("knee, subject of the demo", errors[0].knee, goal),
        ]
        for name in ("knee", "thigh", "shank"):
            figures += median_and_worst(name, [getattr(each, name) for each in errors])
        for name, ideal in (("within_1_sd", 0.68), ("within_2_sd", 0.95)):
            label = f"knee {name.replace('_', ' ')} (ideal {ideal})"
            shares = [getattr(each, name) for each in errors]
            figures += median_and_smallest(label, shares, minimum=round(ideal - 0.05, 9))
        return figures

    return run


def centers(_: Path) -> list[Result]:
    """Measure the distances of the joint centers from the ground truth in the static pose."""
    errors = people("anchored")
    figures: list[Result] = []
    for joint in ("hip", "knee", "ankle"):
        figures += median_and_worst(joint, [each.centers_mm[joint] for each in errors], "mm")
    return figures


IDS: dict[Method, str] = {
    "anchored": "simulated-leg-anchored",
    "patent12": "simulated-leg-patent-separate",
    "patent6": "simulated-leg-patent-shared",
    "mean": "simulated-leg-mean",
}
EXPERIMENTS = (
    *(
        Experiment(
            IDS[method],
            f"Live errors of knee flexion and segments, {len(SEEDS)} simulated subjects, "
            f"method {method}",
            _row(method),
            simulated_subjects(len(SEEDS)),
            long=True,
            headline=method == "anchored",
        )
        for method in METHODS
    ),
    Experiment(
        "simulated-leg-joint-centers",
        f"Errors of the joint centres of {len(SEEDS)} simulated subjects after the functional "
        "calibration",
        centers,
        simulated_subjects(len(SEEDS)),
        long=True,
    ),
)
