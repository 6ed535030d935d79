"""Running joint centers of simulated limbs, with and without a displacement of a joint."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from jointfit_daemon.calibration.anatomy import find_anatomy, static_cluster, track_clusters
from jointfit_daemon.calibration.phases import joint_record
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import SegmentCalibration, cluster_record
from jointfit_daemon.model import MocapFrame, MocapLayout, RunningCenter, RunningCenters
from jointfit_daemon.outputs.payloads._encoding import encode_centers
from jointfit_daemon.pipeline import MovingCenters
from jointfit_daemon.pipeline._moving_centers import chance_of
from tests.calibration.synthetic_limb import (
    CHAIN,
    LOCAL,
    MARKERS,
    SETTINGS,
    Imperfections,
    Motion,
    Subject,
    motion,
    record,
)
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration

MEMORY_S = 5.0
JOINTS = ("hip", "knee", "ankle")


@cache
def calibration(subject: Subject) -> Calibration:
    """Return a calibration with the centers of 15 s of movement, without models of sensors."""
    standing = record(subject, motion(subject, 6.0, 200.0, still=True), 1, sensors=False).optical
    moving = record(subject, motion(subject, 15.0, 200.0), 2, sensors=False).optical
    assert standing is not None
    assert moving is not None
    clusters = {part: static_cluster(standing, part, SETTINGS) for part in MARKERS}
    anatomy = find_anatomy(CHAIN, track_clusters(moving, clusters))
    return replace(
        plain_calibration(CHAIN),
        segment={
            name: SegmentCalibration(as_quaternion(q), *anatomy.lengths[name])
            for name, q in anatomy.q_static.items()
        },
        joint={name: joint_record(found) for name, found in anatomy.joints.items()},
        clusters={name: cluster_record(cluster) for name, cluster in clusters.items()},
    )


def centers_of(
    subject: Subject, moving: Motion, memory_s: float = MEMORY_S
) -> list[RunningCenters]:
    """Return all published centers during a movement seen by the cameras."""
    optical = record(subject, moving, 5, sensors=False).optical
    assert optical is not None
    layout, none = MocapLayout(optical.markers, ()), np.zeros((0, 3))
    running = MovingCenters(CHAIN, calibration(subject), memory_s)
    return [
        found
        for k, (t_ns, row) in enumerate(zip(optical.t_ns.tolist(), optical.positions, strict=True))
        for found in running.add_frame(
            t_ns, MocapFrame(t_ns, k, None, layout, row, none, np.zeros((0, 4)))
        )
    ]


def with_moved_knee(moving: Motion, meters: float, from_s: float) -> Motion:
    """Return a movement with the knee `meters` further forward in the thigh from `from_s` on."""
    offset = np.zeros((len(moving.t_s), 3))
    offset[moving.t_s >= from_s, 1] = meters
    moved = moving.q["thigh"].apply(offset)
    return replace(
        moving,
        p=moving.p | {part: moving.p[part] + moved for part in ("shank", "foot")},
    )


def of(joint: str, found: RunningCenters) -> RunningCenter:
    return next(one for one in found.joints if one.joint == joint)


@pytest.mark.parametrize("skin_m", [0.0, 0.005])
def test_centers_that_do_not_move_are_found_and_not_reported_as_moved(skin_m: float) -> None:
    subject = Subject(4, flaws=Imperfections(skin_m=skin_m))
    moving = motion(Subject(5), 20.0, 200.0)
    told = centers_of(subject, moving)
    assert 17 <= len(told) <= 21
    assert all(one.moved is not True for found in told for one in found.joints)

    # the joint is the origin of its distal segment, whose markers define the running coordinates
    last = told[-1]
    assert [one.joint for one in last.joints] == list(JOINTS)
    assert [one.segment for one in last.joints] == ["pelvis", "thigh", "shank"]
    hip = of("hip", last)
    assert hip.refused is None
    assert hip.position is not None
    at = np.array(
        [np.interp(last.t_ns / 1e9, moving.t_s, moving.p["pelvis"][:, k]) for k in (0, 1, 2)]
    )
    assert np.linalg.norm(np.array(hip.position) - at) < (0.005 if skin_m == 0.0 else 0.03)
    assert hip.effective_frames is not None
    assert hip.effective_frames < 20.0 * 2.2 * MEMORY_S


def test_a_center_that_moves_is_followed_and_reported() -> None:
    subject = Subject(4)
    told = centers_of(subject, with_moved_knee(motion(subject, 24.0, 200.0), 0.02, 8.0), 2.5)
    before = [of("knee", found) for found in told if found.t_ns < 8.0e9]
    assert not any(one.moved for one in before)
    last = of("knee", told[-1])
    assert last.moved is True
    assert last.shift is not None
    assert last.p_value is not None
    assert last.p_value < 1e-4
    assert np.linalg.norm(last.shift) == pytest.approx(0.02, abs=0.004)
    assert last.shift[1] == pytest.approx(0.02, abs=0.004)
    assert last.center is not None
    assert (
        np.linalg.norm(last.center[1:] + np.mean(LOCAL["thigh"], axis=0)[1:] - [0.02, -0.42]) < 0.01
    )
    assert not of("hip", told[-1]).moved


def test_a_limb_at_rest_has_no_running_center() -> None:
    subject = Subject(4)
    told = centers_of(subject, motion(subject, 6.0, 200.0, still=True))
    assert told
    for one in told[-1].joints:
        assert one.refused is not None
        assert (one.center, one.shift, one.moved) == (None, None, None)
    payload = orjson.loads(encode_centers(told[-1], 0))
    assert payload["joints"]["knee"]["center_m"] is None


def test_nothing_is_computed_without_calibration_or_time_constant() -> None:
    subject = Subject(4)
    moving = motion(subject, 6.0, 200.0)
    assert centers_of(subject, moving, 0.0) == []
    layout, none = MocapLayout((), ()), np.zeros((0, 3))
    frame = MocapFrame(0, 0, None, layout, none, none, np.zeros((0, 4)))
    assert MovingCenters(CHAIN, None, MEMORY_S).add_frame(0, frame) == []


def test_frames_without_markers_and_other_names_are_no_movement() -> None:
    running = MovingCenters(CHAIN, calibration(Subject(4)), MEMORY_S)
    layout, none = MocapLayout(("X",), ()), np.zeros((0, 3))
    told = [
        found
        for k in range(200)
        for found in running.add_frame(
            k * 50_000_000,
            MocapFrame(0, k, None, layout, np.full((1, 3), np.nan), none, np.zeros((0, 4))),
        )
    ]
    assert told
    assert all(one.moved is None and one.refused for found in told for one in found.joints)


@given(st.floats(0.0, 60.0), st.integers(1, 3))
def test_probabilities_equal_those_of_scipy(square: float, freedom: int) -> None:
    assert chance_of(square, freedom) == pytest.approx(chi2.sf(square, freedom), abs=1e-12)


def test_the_payload_has_units_and_no_unrounded_numbers() -> None:
    told = centers_of(Subject(4), motion(Subject(4), 8.0, 200.0))[-1]
    payload = orjson.loads(encode_centers(told, 1_000_000_000))
    assert payload["t_us"] == (told.t_ns + 1_000_000_000) // 1000
    assert payload["memory_s"] == MEMORY_S
    knee = payload["joints"]["knee"]
    assert knee["segment"] == "thigh"
    assert len(knee["center_m"]) == len(knee["shift_m"]) == len(knee["p_m"]) == 3
    assert np.shape(knee["covariance_m2"]) == (3, 3)
    assert 0.0 <= knee["p_value"] <= 1.0
    assert knee["moved"] is False


def test_centers_end_when_their_markers_have_been_hidden_for_the_time_constant() -> None:
    subject = Subject(4)
    running = MovingCenters(CHAIN, calibration(subject), MEMORY_S)
    optical = record(subject, motion(Subject(5), 20.0, 200.0), 5, sensors=False).optical
    assert optical is not None
    layout, none = MocapLayout(optical.markers, ()), np.zeros((0, 3))
    told = []
    for k, (t_ns, row) in enumerate(zip(optical.t_ns.tolist(), optical.positions, strict=True)):
        seen = row if t_ns < optical.t_ns[0] + 13e9 else np.full_like(row, np.nan)
        frame = MocapFrame(t_ns, k, None, layout, seen, none, np.zeros((0, 4)))
        told += running.add_frame(t_ns, frame)
    before = next(found for found in reversed(told) if found.t_ns < optical.t_ns[0] + 12.9e9)
    assert of("hip", before).center is not None
    hidden = of("hip", told[-1])
    assert hidden.center is None
    assert hidden.refused is not None
    assert "hidden for" in hidden.refused
