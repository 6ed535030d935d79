"""Builds ROS messages. The classes are arguments, so this module does not import ROS."""

from array import array
from collections.abc import Iterable
from typing import Any

from jointfit_bridge.conversion import JointAngles, SegmentTransform, Stamp


def joint_state(kinds: Any, angles: JointAngles) -> Any:
    """Return a ``sensor_msgs/JointState``; the attributes of `kinds` are message classes."""
    return kinds.JointState(
        header=_header(kinds, angles.stamp, ""),
        name=angles.names,
        position=array("d", angles.positions),
        velocity=array("d", angles.velocities),
        effort=array("d"),
    )


def tf_message(kinds: Any, transforms: Iterable[SegmentTransform]) -> Any:
    """Return a ``tf2_msgs/TFMessage``."""
    return kinds.TFMessage(
        transforms=[
            kinds.TransformStamped(
                header=_header(kinds, one.stamp, one.parent),
                child_frame_id=one.child,
                transform=kinds.Transform(
                    translation=kinds.Vector3(**dict(zip("xyz", one.translation, strict=True))),
                    rotation=kinds.Quaternion(**dict(zip("xyzw", one.rotation, strict=True))),
                ),
            )
            for one in transforms
        ]
    )


def _header(kinds: Any, stamp: Stamp, frame: str) -> Any:
    time = kinds.Time(sec=stamp.sec, nanosec=stamp.nanosec)
    return kinds.Header(stamp=time, frame_id=frame)
