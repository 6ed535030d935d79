"""Running estimates of joint centers of a simulated leg whose knee center moves after calibration.

The experiment counts reports of a moved center, with and without a displacement of the center. The
movement in the calibration (walking, squats, guided movement) differs from the tested movement
(walking, sitting down and standing up), so the soft-tissue artefact differs, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import simulated_subjects
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.calibration import OpticalTrack
from jointfit_daemon.calibration.anatomy import find_anatomy, static_cluster, track_clusters
from jointfit_daemon.calibration.phases import joint_record
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    cluster_record,
)
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline import MovingCenters
from jointfit_simulators.body import SimulatedSubject, Step
from jointfit_simulators.devices import Cameras
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import RunningCenter

WEARERS = (1, 2, 3, 4)
STILL_S, TAUGHT_S, TESTED_S = 8.0, 45.0, 70.0
LEAD_S = 2.0
"""Duration of the transition between two motions, s. It is not evaluated."""
MEMORY_S = 10.0
MOVED_AT_S = 15.0
CAMERAS_HZ = 40.0
RIGID, WORN = 0.0, 5.0
"""RMS soft-tissue artefact of markers, mm: 0 if they are fixed to the bones, 5 on the skin."""


@dataclass(frozen=True)
class Wearer:
    """A calibrated leg and the track of a later movement."""

    calibration: Calibration
    track: OpticalTrack
    forward: Array
    """Forward direction of the thigh in each tested frame, shape (m, 3). The markers are moved in
    this direction."""


@cache
def wearer(seed: int, tissue_mm: float) -> Wearer:
    """Return a simulated leg with the centers of its calibration movement."""
    knobs = Knobs(seed=seed, mocap_hz=CAMERAS_HZ, marker_soft_tissue_mm=tissue_mm)
    moves = ("functional", "walk", "squat")
    steps = [Step("stand", STILL_S), *(Step(name, TAUGHT_S / len(moves)) for name in moves)]
    steps += [Step("walk", TESTED_S / 2), Step("sit_to_stand", TESTED_S / 2)]
    subject = SimulatedSubject(knobs, steps)
    t_s = np.arange(0.0, STILL_S + TAUGHT_S + TESTED_S, 1.0 / CAMERAS_HZ)
    cameras = Cameras(knobs, subject, rate_hz=CAMERAS_HZ)
    frames = cameras.capture(subject.observe([t_s[:1]] * 4, t_s, t_s[:1]))

    def cut(begin_s: float, length_s: float) -> OpticalTrack:
        rows = (t_s >= begin_s + LEAD_S) & (t_s < begin_s + length_s)
        stamps = np.round((t_s[rows] - begin_s) * 1e9).astype(np.int64)
        return OpticalTrack(
            stamps, cameras.markers, frames.markers[rows], cameras.bodies,
            frames.body_positions[rows], frames.body_orientations[rows],
        )  # fmt: skip

    rig = bench_rig()
    settings, chain = rig.calibration, rig.chain
    standing, taught = cut(0.0, STILL_S), cut(STILL_S, TAUGHT_S)
    tested = cut(STILL_S + TAUGHT_S, TESTED_S)
    clusters = {name: static_cluster(standing, name, settings) for name in settings.markers}
    clusters.pop("plate", None)
    anatomy = find_anatomy(chain, track_clusters(taught, clusters))
    joints: dict[str, JointCalibration] = {
        name: joint_record(found) for name, found in anatomy.joints.items()
    }
    calibration = Calibration(
        method="mean",
        joints=chain.joints,
        segments=chain.segments,
        chain_sensors=chain.sensors,
        sensor={},
        segment={
            name: SegmentCalibration(as_quaternion(q), *anatomy.lengths[name])
            for name, q in anatomy.q_static.items()
        },
        joint=joints,
        clusters={name: cluster_record(cluster) for name, cluster in clusters.items()},
    )
    thigh = track_clusters(tested, clusters)["thigh"]
    ahead = rotation.rotate(anatomy.q_static["thigh"], np.array([0.0, 1.0, 0.0]))
    forward = np.nan_to_num(rotation.rotate(thigh.q, ahead))
    return Wearer(calibration, tested, np.asarray(forward))


def followed(one: Wearer, moved_m: float) -> list[tuple[float, RunningCenter]]:
    """Return times, s, and running centers of a movement in which the knee center is displaced.

    At `MOVED_AT_S`, the markers of shank and foot move forward by `moved_m` relative to the thigh.
    """
    rig, track = bench_rig(), one.track
    below = [*rig.calibration.markers["shank"], *rig.calibration.markers["foot"]]
    columns = [track.markers.index(name) for name in below]
    late = track.t_ns >= MOVED_AT_S * 1e9
    positions = track.positions.copy()
    positions[:, columns] += moved_m * np.where(late[:, None], one.forward, 0.0)[:, None]

    running = MovingCenters(rig.chain, one.calibration, MEMORY_S)
    layout = MocapLayout(track.markers, track.bodies)
    told = []
    for k, t_ns in enumerate(track.t_ns.tolist()):
        frame = MocapFrame(
            t_ns, k, None, layout, positions[k],
            track.body_positions[k], track.body_orientations[k],
        )  # fmt: skip
        for found in running.add_frame(t_ns, frame):
            told += [(t_ns / 1e9, center) for center in found.joints]
    return told


def moving(tissue_mm: float, shifts_mm: tuple[float, ...], _: Path) -> list[Result]:
    """Measure false reports without a displacement, and delay and error for each displacement."""
    shares, offsets = [], []
    for seed in WEARERS:
        still = [center for _, center in followed(wearer(seed, tissue_mm), 0.0)]
        compared = [center.moved for center in still if center.moved is not None]
        shares.append(100.0 * sum(compared) / len(compared))
        last = next(each.shift for each in reversed(still) if each.joint == "knee")
        offsets.append(inf if last is None else abs(1e3 * last[1]))
    figures = median_and_worst("knee unmoved: estimates with a report", shares, "%", maximum=1.0)
    figures += median_and_worst("knee unmoved: published shift at the end", offsets, "mm")

    for mm in shifts_mm:
        delays, errors = [], []
        for seed in WEARERS:
            knee = [
                (t_s - MOVED_AT_S, center)
                for t_s, center in followed(wearer(seed, tissue_mm), mm / 1e3)
                if center.joint == "knee" and t_s > MOVED_AT_S
            ]
            first = next((t_s for t_s, center in knee if center.moved), None)
            delays.append(inf if first is None else first)
            shift = knee[-1][1].shift
            errors.append(inf if shift is None else abs(1e3 * shift[1] - mm))
        name = f"knee moved by {mm:g} mm"
        reported = 100.0 * float(np.mean(np.isfinite(delays)))
        figures.append(Result(f"{name}: subjects with a report", reported, unit="%"))
        if reported:
            figures += median_and_worst(f"{name}: time to the report", delays, "s")
        figures += median_and_worst(f"{name}: error of the shift after 55 s", errors, "mm")
    return figures


def _rigid(data: Path) -> list[Result]:
    figures = moving(RIGID, (5.0, 20.0), data)
    return [
        replace(one, minimum=100.0)
        if one.name == "knee moved by 20 mm: subjects with a report"
        else one
        for one in figures
    ]


def _worn(data: Path) -> list[Result]:
    return moving(WORN, (20.0, 60.0), data)


EXPERIMENTS = (
    Experiment(
        "moving-center-rigid",
        "Moving knee centre after calibration, markers rigid on the bones",
        _rigid,
        simulated_subjects(len(WEARERS)),
    ),
    Experiment(
        "moving-center-skin",
        "Moving knee centre after calibration, 5 mm of soft-tissue artefact",
        _worn,
        simulated_subjects(len(WEARERS)),
    ),
)
