"""The ROS 2 bridge: conventions against SciPy, messages against the definitions of ROS 2.

The tests run without ROS 2. The messages are checked with the type store of the package `rosbags`,
which contains the definitions of ROS 2 and converts messages to CDR, the wire format of ROS 2. A
stand-in replaces the node of `rclpy`.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import xml.etree.ElementTree as ET
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from jointfit_daemon.config import parse_rig
from jointfit_daemon.outputs.mqtt import Outbox
from jointfit_daemon.outputs.mqtt._connection import Outgoing
from jointfit_daemon.outputs.payloads import TopicWriter, encode_pose
from jointfit_daemon.outputs.unix_clock import UnixClock
from tests.examples.live_rig import BASE, live_rig
from tests.outputs.payloads.test_payloads import STATE

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

PACKAGE = Path(__file__).resolve().parents[2] / "examples" / "ros2" / "jointfit_bridge"
POSE = json.loads(encode_pose(STATE, 1_795_250_055_351_700_000, 0))
ORIGINS = {"thigh": "hip", "shank": "knee"}
STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = (
    "builtin_interfaces/msg/Time", "geometry_msgs/msg/Quaternion", "geometry_msgs/msg/Transform",
    "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/Vector3", "std_msgs/msg/Header",
    "tf2_msgs/msg/TFMessage",
)  # fmt: skip


def info_of(table: dict[str, Any]) -> bytes:
    """Return the payload of ``bridge/info``."""
    outbox = Outbox("state")
    TopicWriter(parse_rig(table), outbox, UnixClock())
    return outbox.retained[f"{BASE}/bridge/info"]


def bridge_module(name: str) -> Any:
    sys.path.insert(0, str(PACKAGE))
    try:
        return import_module(f"jointfit_bridge.{name}")
    finally:
        sys.path.remove(str(PACKAGE))


def joint_state_of_store(**fields: Any) -> Any:
    """Return the message with NumPy arrays; the type store does not accept `array.array`."""
    arrays = {key: np.asarray(fields.pop(key)) for key in ("position", "velocity", "effort")}
    return STORE.types["sensor_msgs/msg/JointState"](**fields, **arrays)


KINDS = SimpleNamespace(
    JointState=joint_state_of_store,
    **{name.rpartition("/")[2]: STORE.types[name] for name in TYPES},
)


def through_cdr(message: Any) -> Any:
    """Return a message after its conversion to the wire format of ROS 2 and back."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def with_orientation(q: list[float] | None) -> dict[str, Any]:
    segments = POSE["segments"] | {"thigh": POSE["segments"]["thigh"] | {"q": q}}
    return {**POSE, "segments": segments}


def test_angles_and_rates_are_radians_with_the_names_of_their_joint() -> None:
    found = bridge_module("conversion").joint_angles(POSE)
    assert found.names == ["knee_flexion", "knee_adduction", "knee_rotation"]
    assert found.positions == pytest.approx([math.radians(a) for a in (28.31, -1.92, 3.4)])
    assert found.velocities == pytest.approx([math.radians(a) for a in (120.0, -3.0, 0.0)])


def test_unknown_angles_are_left_out_and_an_unknown_rate_leaves_no_rates() -> None:
    knee = POSE["joints"]["knee"] | {"adduction_deg": None, "rotation_deg_s": None}
    found = bridge_module("conversion").joint_angles(POSE | {"joints": {"knee": knee}})
    assert found.names == ["knee_flexion", "knee_rotation"]
    assert found.velocities == []


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_axes_of_a_segment_are_those_of_rep_103(q: list[float]) -> None:
    unit = (np.array(q) / np.linalg.norm(q)).tolist()
    (found,) = bridge_module("conversion").segment_transforms(with_orientation(unit), ORIGINS)
    ours = Rotation.from_quat(unit, scalar_first=True)
    ros = Rotation.from_quat(found.rotation)  # scalar last
    right, anterior, up = np.eye(3)
    np.testing.assert_allclose(ros.apply([1, 0, 0]), ours.apply(anterior), atol=1e-9)
    np.testing.assert_allclose(ros.apply([0, 1, 0]), ours.apply(-right), atol=1e-9)
    np.testing.assert_allclose(ros.apply([0, 0, 1]), ours.apply(up), atol=1e-9)


def test_a_segment_is_at_its_proximal_joint_and_absent_while_unknown() -> None:
    convert = bridge_module("conversion").segment_transforms
    (thigh,) = convert(POSE, ORIGINS, "map")
    assert (thigh.parent, thigh.child, thigh.translation) == ("map", "thigh", (0.0, 0.0, 0.912))
    assert convert(with_orientation(None), ORIGINS) == []
    assert convert(POSE, {}) == []


async def test_origins_follow_the_layout_of_plain_and_of_branched_limbs(
    table: dict[str, Any],
) -> None:
    origins = bridge_module("conversion").segment_origins
    assert origins(json.loads(info_of(table))) == ORIGINS
    branched = {
        "joints": ["origin", "hip_r", "hip_l"],
        "segments": ["pelvis", "thigh_r", "thigh_l"],
        "connections": {
            "hip_r": {"parent": "pelvis", "child": "thigh_r", "side": "right"},
            "hip_l": {"parent": "pelvis", "child": "thigh_l", "side": "left"},
        },
    }
    assert origins(branched) == {"pelvis": "origin", "thigh_r": "hip_r", "thigh_l": "hip_l"}


def test_joint_state_survives_the_wire_format_of_ros() -> None:
    conversion, messages = bridge_module("conversion"), bridge_module("messages")
    angles = conversion.joint_angles(POSE)
    found = through_cdr(messages.joint_state(KINDS, angles))
    assert found.name == angles.names
    assert found.position.tolist() == angles.positions
    assert found.velocity.tolist() == angles.velocities
    assert found.effort.size == 0
    stamp = found.header.stamp
    assert stamp.sec * 1_000_000 + stamp.nanosec // 1000 == POSE["t_us"]
    assert found.header.frame_id == ""


def test_transforms_survive_the_wire_format_of_ros() -> None:
    conversion, messages = bridge_module("conversion"), bridge_module("messages")
    transforms = conversion.segment_transforms(POSE, ORIGINS)
    (found,) = through_cdr(messages.tf_message(KINDS, transforms)).transforms
    assert (found.header.frame_id, found.child_frame_id) == ("world", "thigh")
    moved, turned = found.transform.translation, found.transform.rotation
    assert (moved.x, moved.y, moved.z) == transforms[0].translation
    assert (turned.x, turned.y, turned.z, turned.w) == transforms[0].rotation


class StandInNode:
    """The methods of an `rclpy` node that the bridge calls."""

    def __init__(self, **parameters: Any) -> None:
        self.parameters = parameters
        self.published: dict[str, list[Any]] = {}

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, _kind: Any, topic: str, _depth: int) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def get_logger(self) -> Any:
        return SimpleNamespace(info=lambda _: None)


@pytest.mark.system
async def test_the_bridge_publishes_the_messages_of_a_real_broker(
    broker: Broker, table: dict[str, Any]
) -> None:
    module = bridge_module("node")
    port = broker.port_of("3.1.1")
    node = StandInNode(port=port, base=BASE, topic="pose/ui")
    client = module.mqtt_client(module.Bridge(node, KINDS))
    async with asyncio.timeout(20), live_rig(port, "3.1.1") as rig:
        await rig.publish(Outgoing(f"{BASE}/bridge/info", info_of(table), 1, retain=True))
        client.loop_start()
        try:
            while not node.published["/tf"]:
                await asyncio.sleep(0.02)
        finally:
            client.disconnect()
            client.loop_stop()
    (transform,) = node.published["/tf"][0].transforms
    assert transform.child_frame_id == "thigh"
    assert node.published["joint_states"][0].name[0] == "knee_flexion"


def test_the_package_declares_what_it_imports() -> None:
    package = ET.parse(PACKAGE / "package.xml").getroot()
    declared = {each.text for each in package.findall("exec_depend")}
    assert {"rclpy", "sensor_msgs", "geometry_msgs", "tf2_msgs", "python3-paho-mqtt"} <= declared
    assert package.findtext("export/build_type") == "ament_python"
    assert package.findtext("name") == PACKAGE.name
    assert (PACKAGE / "resource" / PACKAGE.name).exists()
