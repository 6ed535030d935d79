"""Limbs with branches in rig.toml: order of joints and segments, sides, and faults by name."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import pytest

from jointfit_daemon.config import ConfigError, parse_rig

Table = dict[str, Any]
SEGMENTS = ["pelvis", "right_thigh", "right_shank", "left_thigh", "left_shank"]
JOINTS = [
    {"name": "right_hip", "parent": "pelvis", "child": "right_thigh", "side": "right"},
    {"name": "right_knee", "parent": "right_thigh", "child": "right_shank"},
    {"name": "right_ankle", "parent": "right_shank", "child": "right_foot"},
    {"name": "left_hip", "parent": "pelvis", "child": "left_thigh", "side": "left"},
    {"name": "left_knee", "parent": "left_thigh", "child": "left_shank"},
    {"name": "left_ankle", "parent": "left_shank"},
]


@pytest.fixture
def legs(table: Table) -> Table:
    """Return a rig of two legs with one sensor on each segment."""
    imu = table["imu"][0]
    table["chain"] = {"segments": list(SEGMENTS), "joint": [dict(joint) for joint in JOINTS]}
    table["imu"] = [
        imu | {"id": f"S{k}", "segment": segment, "port": f"/dev/ttyS{k}"}
        for k, segment in enumerate(SEGMENTS)
    ]
    table["mocap"]["markers"] = {"right_foot": ["F1", "F2", "F3"]}
    return table


def faults(table: Table) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_rig(table)
    return [fault.text() for fault in caught.value.faults]


def test_two_legs_share_the_pelvis_in_any_order_of_the_tables(legs: Table) -> None:
    for order in list(permutations(range(6)))[::97]:
        legs["chain"]["joint"] = [dict(JOINTS[k]) for k in order]
        chain = parse_rig(legs).chain
        parent = dict(zip(chain.joints, chain.parents, strict=True))
        assert chain.segments[0] == "pelvis"
        assert chain.joints[0] == "pelvis_origin"
        assert parent["pelvis_origin"] is None
        for number, joint in enumerate(chain.joints[1:], 1):
            given = next(each for each in JOINTS if each["name"] == joint)
            above = parent[joint]
            assert above is not None
            assert above < number  # a segment follows its proximal segment
            assert chain.segments[above] == given["parent"]
            assert chain.left_joints[number] == joint.startswith("left")
            if number < len(SEGMENTS):
                assert chain.segments[number] == given["child"]
        ends = dict(zip(chain.joints[len(SEGMENTS) :], chain.distals, strict=True))
        assert ends == {"right_ankle": "right_foot", "left_ankle": None}


def test_a_branched_rig_describes_no_line(legs: Table) -> None:
    legs["chain"] |= {"joints": ["hip", "knee"], "proximal": "pelvis", "side": "left"}
    legs["chain"]["motion"] = "planar"
    found = faults(legs)
    for key in ("joints", "proximal", "side", "motion"):
        expected = f"chain.{key}: is for a limb without branches; remove it, or [[chain.joint]]"
        assert expected in found


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({4: {"name": "right_knee"}}, "chain.joint = 'right_knee': 2 tables have this name (par"),
        ({4: {"child": "right_shank"}}, "'right_shank': is the child of 'right_knee' already"),
        ({3: {"parent": "left_shank"}}, "form a cycle: left_thigh – left_shank – left_thigh;"),
        ({3: {"child": "left_thihg"}}, "have no proximal joint: pelvis, left_thigh; expected one"),
        ({1: {"parent": "right_tigh"}}, "did you mean 'right_thigh'?"),
        ({1: {"child": "right_thigh"}}, "is also its parent"),
        ({2: None}, "segment 'right_shank' carries 0 joints (none), expected one: add its distal"),
        ({3: {"side": "right"}}, "found right_hip: right, left_hip: right"),
        ({3: {"side": None}}, "found right_hip: right, left_hip: no side"),
        ({4: {"side": "right"}}, "chain.joint[left_knee].side = 'right': expected 'left'"),
        ({2: {"name": "pelvis_origin"}}, "is the name of the origin of 'pelvis'"),
        ({5: {"parent": "left_thigh"}}, "only the first segment ('pelvis') has branches"),
        ({0: {"parent": ["pelvis", "trunk"]}}, "chain.joint[0].parent"),
    ],
)  # fmt: skip
def test_wrong_connections_are_named(legs: Table, changes: Table, words: str) -> None:
    for number, change in changes.items():
        joint = legs["chain"]["joint"][number]
        joint.update(change or {"name": None})
        if joint.get("side", "") is None:
            del joint["side"]
    legs["chain"]["joint"] = [joint for joint in legs["chain"]["joint"] if joint["name"]]
    legs["mocap"]["markers"] = {"pelvis": ["F1", "F2", "F3"]}
    assert any(words in text for text in faults(legs)), faults(legs)


def test_a_segment_in_no_joint_and_a_third_branch_are_named(legs: Table) -> None:
    legs["chain"]["segments"].append("trunk")
    legs["imu"].append(legs["imu"][0] | {"id": "S9", "segment": "trunk", "port": "/dev/ttyS9"})
    assert any("'trunk': is in no [[chain.joint]]" in text for text in faults(legs))

    legs["chain"]["joint"] += [
        {"name": "lumbar", "parent": "pelvis", "child": "trunk"},
        {"name": "neck", "parent": "trunk"},
    ]
    assert any("carries 3 joints (right_hip, left_hip, lumbar)" in text for text in faults(legs))


def test_a_joint_center_of_a_branched_limb_needs_markers_on_both_sides(legs: Table) -> None:
    legs["calibration"] = {"joint_center_methods": {"left_ankle": "sara", "left_hip": "score"}}
    found = faults(legs)
    assert any("add chain.joint[left_ankle].child and its markers" in text for text in found)
    assert any("add mocap.markers.left_thigh" in text for text in found)
