"""Calibration and live angles of simulated arms, trunks and pairs of legs.

The orientations do not pass through codecs and drivers. Each seed is another subject, with the
default settings of the simulator. Subjects differ in sensor-to-segment alignment, headings,
soft-tissue artefact, markers and sensor errors. A subject is calibrated with the sensors on a
plate, in a static pose and in 60 s of movement. The angles are evaluated in 24 s of later movement.
The truth is the angles of the bones, in the convention of each joint.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.experiments.fusion.simulated_leg import take_pose
from bench.framework.experiment import Experiment, Result
from bench.framework.material import simulated_subjects
from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.limb_model import flexion_sign, inner_joints, is_left
from jointfit_daemon.model import AngleConvention
from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import SimulatedSubject, Step, to_wxyz
from jointfit_simulators.devices import Cameras, OrientationSensor
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.config import Rig
    from jointfit_daemon.model import LimbState

SEEDS = tuple(range(1, 6))
BEGIN_S, EACH_S, RATE_HZ = 100.0, 8.0, 50.0
MOVEMENTS = {
    "arm": ("abduction", "elbow_flexion", "reach"),
    "trunk": ("bend", "twist", "side_bend"),
    "legs": ("walk", "squat", "sit_to_stand"),
}
GOAL_DEG = {"arm": 4.0, "trunk": 3.0, "legs": 3.0}
"""Threshold for the median error of the main angle of every joint, deg."""
RAISED = np.radians(30.0)
"""Elevation above which the plane of elevation is well enough defined for the evaluation, rad."""
ANGLES = {
    AngleConvention.FLEXION: ("flexion", "adduction", "rotation"),
    AngleConvention.ELEVATION: ("plane of elevation", "elevation", "axial rotation"),
    AngleConvention.TILT_TORSION: ("flexion", "adduction", "torsion"),
    AngleConvention.TRUNK: ("flexion", "bending", "rotation"),
}
_UNDEFINED_AT_REST = ("plane of elevation", "axial rotation")


class _Live(NamedTuple):
    states: list[LimbState]
    bones: Mapping[str, Array]
    """Orientations q_optical_segment by segment, shape (n, 4)."""


def spread(limb: str, _: Path) -> list[Result]:
    """Return the median and worst RMS errors over the subjects, for angles and segments."""
    rig = bench_rig(limb=limb)
    subjects = [found for seed in SEEDS if (found := _live(limb, rig, seed)) is not None]
    figures = [
        Result("subjects accepted", float(len(subjects)), len(SEEDS), len(SEEDS) - 1, unit="")
    ]
    errors = [_errors(rig, live) for live in subjects]
    for name in errors[0]:
        values = [each[name] for each in errors]
        goal = GOAL_DEG[limb] if name.endswith((": flexion", ": elevation")) else np.inf
        figures += [
            Result(f"{name}, median", float(np.median(values)), goal),
            Result(f"{name}, worst", max(values)),
        ]
    return figures


def _live(limb: str, rig: Rig, seed: int) -> _Live | None:
    """Return the fused states of one subject and its bones; None if its static pose is refused."""
    trials = phases(seed, limb=limb)
    alignment = fit_plate_alignment(trials.align, rig.calibration)
    pose = take_pose(trials.static, rig)
    if pose is None:
        return None
    calibration = fit_calibration(pose, trials.functional, alignment, rig.calibration, rig.chain)

    knobs = Knobs(seed=seed)
    steps = [Step("stand", BEGIN_S), *(Step(name, EACH_S) for name in MOVEMENTS[limb])]
    wearer = SimulatedSubject(knobs, steps, limb=limb)
    t_s = np.arange(BEGIN_S, BEGIN_S + EACH_S * len(MOVEMENTS[limb]), 1 / RATE_HZ)
    seen = wearer.observe([t_s] * len(wearer.sensors), np.empty(0), t_s)
    world = Cameras(knobs, wearer, rate_hz=knobs.mocap_hz).world

    said = {
        name: OrientationSensor(knobs, name).report(t_s, q).tolist()
        for name, q in zip(wearer.sensors, seen.sensors, strict=True)
    }
    fuser = LimbFuser(rig.chain, calibration)
    states = []
    for i, t_ns in enumerate(np.round(t_s * NS_PER_S).astype(int).tolist()):
        sensors = {name: tuple(q[i]) for name, q in said.items()}
        states.append(fuser.fuse(t_ns, t_ns, i, sensors))
    bones = {part: to_wxyz(world * q) for part, q in seen.truth.orientations.items()}
    return _Live(states, bones)


def _errors(rig: Rig, live: _Live) -> dict[str, float]:
    """Return RMS errors, deg, by name of the joint and angle or by name of the segment."""
    chain, found = rig.chain, dict[str, float]()
    for joint in inner_joints(chain):
        name, states = chain.joints[joint.number], [s.joints[joint.number] for s in live.states]
        true = [
            read_joint(
                proximal,
                distal,
                flexion_sign=flexion_sign(name),
                left=is_left(chain, joint.number),
                convention=states[0].convention,
            )
            for proximal, distal in zip(
                *(live.bones[chain.segments[k]].tolist() for k in (joint.proximal, joint.distal)),
                strict=True,
            )
        ]
        for axis, angle in enumerate(ANGLES[states[0].convention]):
            pairs = [
                (state.angles[axis], bones.angles[axis])
                for state, bones in zip(states, true, strict=True)
                if state.angles is not None
                and (angle not in _UNDEFINED_AT_REST or bones.angles.adduction > RAISED)
            ]
            off = np.angle(np.exp(1j * np.subtract(*np.transpose(pairs))))  # handles the jump at pi
            found[f"{name}: {angle}"] = _rms_deg(off)

    for i, segment in enumerate(chain.segments):
        said = np.array([state.segments[i].q_world_segment for state in live.states])
        off = rotation.angle_between(said, live.bones[segment])
        found[f"{segment}: orientation"] = _rms_deg(off)
    return found


def _rms_deg(angles: Array) -> float:
    return float(np.rad2deg(np.sqrt(np.mean(np.square(angles)))))


EXPERIMENTS = tuple(
    Experiment(
        f"simulated-{limb}",
        f"Live errors of {len(SEEDS)} simulated subjects: {what}",
        partial(spread, limb),
        simulated_subjects(len(SEEDS)),
        long=True,
    )
    for limb, what in (
        ("arm", "shoulder, elbow and wrist, six sensors"),
        ("trunk", "lumbar joint, four sensors"),
        ("legs", "both legs on one pelvis, ten sensors"),
    )
)
