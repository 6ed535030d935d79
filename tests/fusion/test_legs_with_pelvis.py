"""Two legs with a shared pelvis: positions, angles of both sides, and their stored calibration."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.phases._static_pose import StaticPose, fit_static_only
from jointfit_daemon.calibration.record._content_check import content_faults
from jointfit_daemon.calibration.registration import RobustMean
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.fusion._sensor_states import sensor_states
from jointfit_daemon.kinematics.joint_angles import read_patent
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import Calibration, branch_runs, inner_joints, joint_parts
from jointfit_daemon.model import Chain, JointAngles, LimbState, Quaternion
from jointfit_daemon.outputs.payloads import encode_pose

LENGTHS = (0.18, 0.42, 0.40, 0.43, 0.39)
LEGS = Chain(
    ("pelvis_origin", "right_hip", "right_knee", "left_hip", "left_knee", "right_ankle",
     "left_ankle"),
    ("pelvis", "right_thigh", "right_shank", "left_thigh", "left_shank"),
    (("S1", "S2"), ("S3", "S4"), ("S5",), ("S6", "S7"), ("S8",)),
    lengths=LENGTHS,
    parents=(None, 0, 1, 0, 3, 2, 4),
    left_joints=(False, False, False, True, True, False, True),
    distals=("right_foot", "left_foot"),
)  # fmt: skip
LINE = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1",), ("S2",)))
PARENT, CHILD = [0, 1, 0, 3], [1, 2, 3, 4]
MIRROR = np.diag([-1.0, 1.0, 1.0])

turns = st.lists(st.floats(-0.9, 0.9), min_size=15, max_size=15).map(
    lambda values: Rotation.from_rotvec(np.reshape(values, (5, 3)))
)


def upright(chain: Chain) -> Calibration:
    still = RobustMean(np.array([1.0, 0.0, 0.0, 0.0]), 0.0)
    pose = StaticPose({name: still for group in chain.sensors for name in group}, 5.0)
    return fit_static_only(pose, None, chain)


def fused(bones: Rotation, chain: Chain = LEGS) -> LimbState:
    orientations: dict[str, Quaternion] = {}
    for group, q in zip(chain.sensors, bones.as_quat(scalar_first=True).tolist(), strict=True):
        orientations |= dict.fromkeys(group, tuple(q))
    return LimbFuser(chain, upright(chain)).fuse(0, 0, 0, orientations)


def angles_of(state: LimbState) -> dict[str, JointAngles | None]:
    return {joint.name: joint.angles for joint in state.joints}


@given(turns)
def test_positions_follow_both_legs_from_the_middle_of_the_pelvis(bones: Rotation) -> None:
    state = fused(bones)
    pelvis, thigh_r, shank_r, thigh_l, shank_l = bones.as_matrix()
    down = np.array([0.0, 0.0, -1.0])
    right, left = pelvis @ [0.09, 0, 0], pelvis @ [-0.09, 0, 0]
    expected = {
        "pelvis_origin": np.zeros(3),
        "right_hip": right,
        "right_knee": right + 0.42 * thigh_r @ down,
        "right_ankle": right + 0.42 * thigh_r @ down + 0.40 * shank_r @ down,
        "left_hip": left,
        "left_knee": left + 0.43 * thigh_l @ down,
        "left_ankle": left + 0.43 * thigh_l @ down + 0.39 * shank_l @ down,
    }
    for joint in state.joints:
        assert joint.position == pytest.approx(expected[joint.name], abs=1e-9), joint.name
        assert joint.position_sd is not None


@given(turns)
def test_mirrored_legs_have_the_same_angles_on_the_other_side(bones: Rotation) -> None:
    """A reflection about the sagittal plane exchanges the legs, so the angles are exchanged."""
    reflected = Rotation.from_matrix(MIRROR @ bones.as_matrix() @ MIRROR)[[0, 3, 4, 1, 2]]
    one, other = angles_of(fused(bones)), angles_of(fused(reflected))
    for joint in ("hip", "knee"):
        for a, b in (("right", "left"), ("left", "right")):
            assert one[f"{a}_{joint}"] == pytest.approx(other[f"{b}_{joint}"], abs=1e-9)
    assert one["pelvis_origin"] is None
    assert one["left_ankle"] is None


def test_a_lost_leg_leaves_the_other_one_complete() -> None:
    rest: Quaternion = (1.0, 0.0, 0.0, 0.0)
    worn = {name: rest for group in LEGS.sensors for name in group if name not in ("S6", "S7")}
    state = LimbFuser(LEGS, upright(LEGS)).fuse(0, 0, 0, worn)
    placed = {joint.name for joint in state.joints if joint.position is not None}
    assert placed == {"pelvis_origin", "right_hip", "right_knee", "right_ankle", "left_hip"}
    assert {name for name, found in angles_of(state).items() if found} == {
        "right_hip", "right_knee",
    }  # fmt: skip


@given(turns)
def test_joint_rotations_and_payload_use_the_segment_that_carries_the_joint(
    bones: Rotation,
) -> None:
    state = fused(bones)
    published = json.loads(encode_pose(state, 0, 0))["joints"]
    assert "patent" not in published["right_ankle"]
    states = sensor_states(LEGS, None, {}, state)
    assert [name for name, _ in states.joints] == [
        "right_hip", "right_knee", "left_hip", "left_knee",
    ]  # fmt: skip
    expected = bones[PARENT].inv() * bones[CHILD]
    for k, (name, q) in enumerate(states.joints):
        assert q is not None
        turn = Rotation.from_quat(q, scalar_first=True)
        assert (turn.inv() * expected[k]).magnitude() < 1e-7
        ends = bones[[PARENT[k], CHILD[k]]].as_quat(scalar_first=True).tolist()
        patent = read_patent(*(as_quaternion(q) for q in ends))
        assert published[name]["patent"]["joint_deg"] == pytest.approx(
            np.degrees(patent[3]), abs=0.006
        )


def test_order_of_a_line_is_that_of_its_lists() -> None:
    """In a limb without branches, joints and segments have the order of their lists."""
    assert [joint[1:] for joint in inner_joints(LINE)] == [("knee", 0, 1)]
    assert joint_parts(LINE) == [(0, 1), (1, 2), (2, 3)]
    assert branch_runs(LINE) == [[0, 1, 2]]
    assert branch_runs(LEGS) == [[0], [1, 2, 5], [3, 4, 6]]


def test_a_stored_calibration_contains_its_branches_and_a_line_has_none() -> None:
    stored = upright(LEGS)
    form = json.loads(json.dumps(stored.to_dict()))
    assert Calibration.from_dict(form) == stored
    assert content_faults(stored) == []
    assert stored.fits(LEGS)
    assert not stored.fits(replace(LEGS, left_joints=(*LEGS.left_joints[:-1], False)))
    assert not stored.fits(replace(LEGS, parents=(None, 0, 1, 0, 1, 2, 4)))

    line = upright(LINE)
    assert not {"parents", "left_joints"} & line.to_dict().keys()
    assert Calibration.from_dict(line.to_dict()).fits(LINE)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("parents", (None, 0, 1)),
        ("parents", (None, 0, 1, 0, 4, 2, 4)),
        ("parents", (0, 0, 1, 0, 3, 2, 4)),
        ("parents", (None, 0, 1, 0, 1, 2, 4)),
        ("parents", (None, 0, True, 0, 3, 2, 4)),
        ("left_joints", (False,) * 7),
        ("left_joints", (0, 0, 0, 1, 1, 0, 1)),
    ],
)
def test_a_damaged_tree_is_refused(key: str, value: tuple[object, ...]) -> None:
    found = content_faults(replace(upright(LEGS), **{key: cast("Any", value)}))
    assert found
    assert key in found[0]
