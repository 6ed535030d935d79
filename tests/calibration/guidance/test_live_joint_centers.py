"""Joint centers frame by frame: true error, predicted error, and absence of NaN."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.anatomy import static_cluster, track_clusters
from jointfit_daemon.calibration.guidance import MovementGuide, most_urgent
from jointfit_daemon.calibration.guidance._live_joint_centers import LiveJointCenters
from jointfit_daemon.model import MocapFrame, MocapLayout
from tests.calibration.synthetic_limb import (
    CHAIN,
    LENGTH,
    MARKERS,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    record,
    static_and_functional,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.calibration import CalibrationSettings, CalibrationTrial, OpticalTrack
    from jointfit_daemon.calibration.guidance import MovementStatus

EVERY = 24
"""Number of frames between two status checks."""


@cache
def trials(seed: int = 0, skin_m: float = 0.004) -> tuple[CalibrationTrial, OpticalTrack]:
    """Return a static pose and 30 s of walking, squats and hip circles."""
    subject = Subject(seed, flaws=Imperfections(skin_m=skin_m))
    static, functional, _ = static_and_functional(subject)
    assert functional.optical is not None
    return static, functional.optical


def frames(track: OpticalTrack, positions: np.ndarray | None = None) -> Iterator[MocapFrame]:
    layout = MocapLayout(track.markers, track.bodies)
    seen = track.positions if positions is None else positions
    for i, t_ns in enumerate(track.t_ns.tolist()):
        yield MocapFrame(
            t_ns, i, None, layout, seen[i], track.body_positions[i], track.body_orientations[i]
        )


def watched(
    static: CalibrationTrial,
    track: OpticalTrack,
    positions: np.ndarray,
    settings: CalibrationSettings = SETTINGS,
) -> MovementStatus:
    """Return the last status of a movement; require finite values in all payloads."""
    guide = MovementGuide(CHAIN, settings, static)
    look = guide.update({}, 0.0)
    for i, frame in enumerate(frames(track, positions)):
        guide.add_mocap(frame)
        if i % EVERY == 0:
            look = guide.update({}, i / 120)
            json.dumps({"joints": look.joints, "parts": look.parts}, allow_nan=False)
    return look


def spoiled(part: str, track: OpticalTrack) -> tuple[np.ndarray, list[int]]:
    return track.positions.copy(), [track.markers.index(name) for name in MARKERS[part]]


@pytest.mark.parametrize("seed", [0, 1])
def test_live_centers_approach_the_truth_within_their_predicted_error(seed: int) -> None:
    static, track = trials(seed)
    assert static.optical is not None
    clusters = {name: static_cluster(static.optical, name, SETTINGS) for name in MARKERS}
    live = LiveJointCenters(CHAIN, clusters)
    told = []
    for i, frame in enumerate(frames(track)):
        live.feed(frame)
        if i % EVERY == 0:
            told.append(live.estimate_centers())
    standing = motion(Subject(seed), 6.0, 400.0, still=True)
    truth = {"hip": "thigh", "knee": "shank", "ankle": "foot"}
    off = {
        joint: float(np.linalg.norm(one.center - standing.p[truth[joint]][0]))
        for joint, one in told[-1].items()
        if one.center is not None
    }
    assert off.keys() == {"hip", "knee", "ankle"}
    for joint, one in told[-1].items():
        assert off[joint] < 3.0 * one.total, joint
        assert one.noise < one.total < 0.04, joint
    assert told[-1]["knee"].noise < told[len(told) // 2]["knee"].noise
    hip, knee = told[-1]["hip"].center, told[-1]["knee"].center
    assert hip is not None
    assert knee is not None
    assert np.linalg.norm(knee - hip) == pytest.approx(LENGTH["thigh"], abs=0.03)


def test_the_poses_of_a_frame_are_those_of_the_whole_trial() -> None:
    static, track = trials()
    assert static.optical is not None
    clusters = {name: static_cluster(static.optical, name, SETTINGS) for name in MARKERS}
    whole = track_clusters(track, clusters)
    live = LiveJointCenters(CHAIN, clusters)
    for i, frame in zip(range(200), frames(track), strict=False):
        live.feed(frame)
        for k, name in enumerate(live.parts.names):
            assert live.parts.p[k] == pytest.approx(whole[name].p[i], abs=1e-9)


def test_an_occluded_body_part_is_named_with_its_remedy() -> None:
    static, track = trials()
    positions, columns = spoiled("pelvis", track)
    positions[:, columns] = np.nan
    look = watched(static, track, positions)
    assert "pelvis" in most_urgent(look.missing)
    assert "toward the cameras" in most_urgent(look.missing)
    assert look.joints["hip"]["predicted_error_mm"] is None
    assert look.joints["hip"]["source"] == "unknown"
    assert look.joints["knee"]["source"] != "sensors", "the other joints are still reported"


def test_swapped_names_are_named() -> None:
    static, track = trials()
    positions, columns = spoiled("thigh", track)
    positions[:, columns[:2]] = positions[:, columns[1::-1]]
    look = watched(static, track, positions)
    (text,) = [text for text in look.missing if text.startswith("thigh")]
    assert "thigh0 is at the place of thigh1" in text


def test_a_marker_that_moved_since_the_static_pose_is_named() -> None:
    static, track = trials()
    positions, columns = spoiled("shank", track)
    positions[:, columns[3]] += [0.0, 0.0, 0.4]
    (text,) = [t for t in watched(static, track, positions).missing if t.startswith("shank")]
    assert "shank3" in text
    assert "static pose" in text


def test_occasional_jumps_of_a_marker_do_not_affect_live_centers() -> None:
    static, track = trials()
    part = slice(0, 15 * 120)  # contains five seconds of each of the three movements
    track = replace(
        track,
        t_ns=track.t_ns[part],
        positions=track.positions[part],
        body_positions=track.body_positions[part],
        body_orientations=track.body_orientations[part],
    )
    positions, columns = spoiled("shank", track)
    positions[::40, columns[0]] += [0.3, 0.0, 0.0]
    look, clean = watched(static, track, positions), watched(static, track, track.positions)
    for joint in ("knee", "ankle"):
        jumped, still = look.joints[joint], clean.joints[joint]
        assert jumped["predicted_error_mm"] == pytest.approx(still["predicted_error_mm"], rel=0.05)


def test_without_motion_no_center_is_reported_and_movement_of_every_joint_is_requested() -> None:
    static, _ = trials()
    still = record(
        Subject(flaws=Imperfections(skin_m=0.0)), motion(Subject(), 6.0, 400.0, still=True), 3
    )
    assert still.optical is not None
    look = watched(static, still.optical, still.optical.positions)
    assert len([text for text in look.missing if "movement too small" in text]) == 3
    assert all(joint["predicted_error_mm"] is None for joint in look.joints.values())


def test_sideways_movement_is_requested_of_a_hip_that_moves_about_one_axis() -> None:
    subject = Subject(flaws=Imperfections(skin_m=0.0))
    bones = motion(subject, 12.0, 400.0)
    q, p = bones.q, bones.p
    flexed = type(q["thigh"]).from_euler("x", 0.5 * np.sin(2 * bones.t_s)[:, None])
    plane = replace(bones, q=q | {"pelvis": q["pelvis"][:1] * flexed * flexed.inv()})
    thigh = plane.q["pelvis"] * flexed
    knees = p["pelvis"] + thigh.apply([0, 0, -LENGTH["thigh"]])
    plane = replace(plane, q=plane.q | {"thigh": thigh}, p=p | {"shank": knees})
    track = record(subject, plane, 2).optical
    static, _ = trials(0, 0.0)
    assert track is not None
    look = watched(static, track, track.positions)
    assert "no circumduction" in str(look.joints["hip"]["unseen"])
    assert "sideways" in str(look.joints["hip"]["unseen"])

    # an estimator for one axis does not need a sideways movement, and would refuse it
    one_axis = replace(SETTINGS, joint_center_methods={"hip": "three_frames"})
    look = watched(static, track, track.positions, one_axis)
    assert "sideways" not in str(look.missing)
    assert look.joints["hip"]["met"] is True


def test_a_frame_without_markers_or_with_other_names_is_ignored() -> None:
    static, track = trials()
    guide = MovementGuide(CHAIN, SETTINGS, static)
    nothing = MocapFrame(
        0, 0, None, MocapLayout((), ()), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4))
    )
    for _ in range(400):
        guide.add_mocap(nothing)
    assert "check the names" in most_urgent(guide.update({}, 3.0).missing)
    for frame in frames(track):
        guide.add_mocap(frame)
    looks = [guide.update({}, 30.0) for _ in range(3)]
    assert looks[-1].joints["hip"]["source"] == "markers"


def test_an_end_joint_without_markers_has_its_configured_length_or_nothing() -> None:
    chain = replace(CHAIN, distal=None, lengths=(None, 0.4))
    static, _ = trials()
    look = MovementGuide(chain, SETTINGS, static).update({}, 0.0)
    assert look.joints["ankle"]["source"] == "configured"
    assert look.joints["ankle"]["met"] is True, (
        "the phase waits for a joint that cannot be estimated"
    )
    unknown = MovementGuide(replace(chain, lengths=()), SETTINGS, static)
    assert unknown.update({}, 0.0).joints["ankle"]["source"] == "unknown"
