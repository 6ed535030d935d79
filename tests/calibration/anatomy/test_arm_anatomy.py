"""Segment frames of an arm from markers, for shoulder movements in several directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.calibration import CalibrationSettings, OpticalTrack
from jointfit_daemon.calibration.anatomy import (
    Anatomy,
    find_anatomy,
    static_cluster,
    track_clusters,
)
from jointfit_simulators.body import LIMBS, SimulatedSubject, Step
from jointfit_simulators.settings import Knobs, perfect

KIND = LIMBS["arm"]
CHAIN = bench_rig(limb="arm").chain
STAND_S, MOVE_S, HZ = 3.0, 8.0, 20.0


def anatomy(*motions: str, stiff: bool = False) -> Anatomy:
    """Return the anatomy from the given motions of a subject without soft-tissue artefact.

    If `stiff`, forearm and hand rotate with the upper arm.
    """
    steps = [Step("stand", STAND_S + 2.0), *(Step(name, MOVE_S) for name in motions)]
    subject = SimulatedSubject(perfect(Knobs()), steps, limb="arm")
    parts = [part for part in KIND.clusters if part != "plate"]
    names = tuple(name for cluster in KIND.clusters.values() for name in cluster)
    settings = CalibrationSettings(markers={part: KIND.clusters[part] for part in parts})

    def track(begin_s: float, end_s: float) -> OpticalTrack:
        t_s = np.arange(begin_s, end_s, 1 / HZ)
        markers = subject.observe([np.empty(0)] * len(subject.sensors), t_s, np.empty(0)).markers
        nothing = np.empty((len(t_s), 0, 3))
        t_ns = np.round(t_s * 1e9).astype(np.int64)
        return OpticalTrack(t_ns, names, markers, (), nothing, np.empty((len(t_s), 0, 4)))

    still = track(0.0, STAND_S)
    clusters = {part: static_cluster(still, part, settings) for part in parts}
    moved = track(STAND_S + 3.0, STAND_S + 2.0 + MOVE_S * len(motions))
    tracks = dict(track_clusters(moved, clusters))
    if stiff:
        for part in ("forearm", "hand"):
            tracks[part] = replace(tracks[part], q=tracks["upper_arm"].q)
    return find_anatomy(CHAIN, tracks)


@pytest.mark.parametrize("raising", ["arm_swings", "abduction", "reach"])
def test_the_frames_of_an_arm_do_not_depend_on_the_direction_of_the_shoulder(raising: str) -> None:
    found = anatomy(raising, "elbow_flexion", "wrist_circles")
    for segment in CHAIN.segments:  # all segment axes of an upright subject equal the world axes
        turn = Rotation.from_quat(found.q_static[segment], scalar_first=True)
        assert np.degrees(turn.magnitude()) < 6.0, segment
    assert not [flag for flag in found.flags if flag.startswith("axis_from_shoulder")]
    assert "main movement of the shoulder" not in " ".join(found.notes)


def test_an_arm_that_is_only_swung_takes_its_frames_from_the_elbow_that_swings_along() -> None:
    found = anatomy("arm_swings")
    turn = Rotation.from_quat(found.q_static["thorax"], scalar_first=True)
    assert np.degrees(turn.magnitude()) < 10.0
    assert not [flag for flag in found.flags if flag.startswith("axis_from_shoulder")]


def test_a_stiff_arm_takes_its_frames_from_the_shoulder_and_has_a_flag() -> None:
    found = anatomy("abduction", stiff=True)
    assert {f"axis_from_shoulder:{segment}" for segment in CHAIN.segments} <= set(found.flags)
    assert "thorax, upper_arm, forearm, hand: the flexion axis is the axis" in found.notes[-1]
    assert "bend elbow or wrist in the functional phase" in found.notes[-1]
