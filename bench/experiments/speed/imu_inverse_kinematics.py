"""Joint angles of a recorded walk: the fusion of this project, and OpenSim's inverse kinematics.

The recorded sensors have neither redundancy nor an optical reference. The experiment compares cost
and agreement of both methods, not their accuracy.
"""

from __future__ import annotations

import gc
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import DATA
from bench.framework.measurement import loop_s, speed_experiment, timed_result
from bench.subjects.model_joint_centers import quiet
from bench.subjects.opensense_walk import (
    COORDINATES,
    FOLDER,
    RATE_HZ,
    OpenSimTracker,
    legs_rig,
    read_walk,
    standing_calibration,
)
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from bench.framework.experiment import Result
    from jointfit_daemon.model import LimbState

FRAMES = range(725, 1500)
"""Frames with walking, as in the set-up file of OpenSim's example."""
QUICK_FRAMES = range(725, 775)
ROUNDS, QUICK_ROUNDS = 3, 1


def rows(quick: bool) -> list[Result]:
    """Return the CPU time of a frame of both methods, and the difference of their angles."""
    frames = QUICK_FRAMES if quick else FRAMES
    walk, rig = read_walk(DATA), legs_rig()
    calibration = standing_calibration(rig, walk.frames[0])
    own_s, opensim_s, loops_s = [], [], []
    states: list[LimbState] = []
    tracked: list[list[float]] = []
    with tempfile.TemporaryDirectory() as name, quiet():
        tracker = OpenSimTracker(walk, DATA, Path(name))
        for _ in range(QUICK_ROUNDS if quick else ROUNDS):
            gc.collect()
            loops_s.append(loop_s())
            fuser = LimbFuser(rig.chain, calibration)
            began_s = time.thread_time()
            states = [fuser.fuse(k * NS_PER_S // RATE_HZ, 0, k, walk.frames[k]) for k in frames]
            own_s.append((time.thread_time() - began_s) / len(frames))

            tracker.begin(frames[0])
            began_s = time.thread_time()
            tracked = [tracker.track(k) for k in frames]
            opensim_s.append((time.thread_time() - began_s) / len(frames))

    own, peer, loop = map(statistics.median, (own_s, opensim_s, loops_s))
    found = [
        timed_result(
            "jointfit: fusion of a frame of 7 sensors", round(1e6 * own, 1), "µs",
            ratio=round(own / loop, 2),
        ),
        timed_result(
            "OpenSim: IMU inverse kinematics of the same frame", round(1e6 * peer), "µs",
            ratio=round(peer / loop, 1), note=f"{peer / own:.0f} times the fusion",
        ),
    ]  # fmt: skip
    differences = np.degrees(np.array(tracked) - np.array([_flexions(one) for one in states]))
    for joint, of_joint in zip(COORDINATES, differences.T, strict=True):
        rms = float(np.sqrt(np.mean(of_joint**2)))
        title = f"difference of flexion, {joint.replace('_', ' ')}: RMS"
        found.append(timed_result(title, round(rms, 2), "deg"))
    return found


def _flexions(state: LimbState) -> list[float]:
    """Return the flexion of the joints of `COORDINATES`, rad."""
    angles = {joint.name: joint.angles for joint in state.joints}
    found = []
    for name in COORDINATES:
        known = angles[name]
        assert known is not None
        found.append(known[0])
    return found


EXPERIMENTS = (
    speed_experiment(
        "imu-inverse-kinematics",
        "Angles of a walk from 7 sensors: fusion, and OpenSim's inverse kinematics",
        rows,
        recordings=(FOLDER,),
        packages=("opensim",),
    ),
)
