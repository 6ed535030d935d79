"""Converts a payload of ``pose`` to joint angles and transforms with the conventions of ROS.

The module does not import ROS, so it can be tested without ROS.

Units are SI and radians (REP 103). The world is ENU (x east, y north, z up), as in jointfitd. The
axes of a ROS body are x forward, y left, z up. A segment of jointfitd has x to the right, y
forward, z up. Quaternions of ROS have the scalar last. Every frame is a child of the fixed frame
`world` (REP 105), so a segment without data affects no other frame.
"""

from math import radians, sqrt
from typing import Any, NamedTuple

ANGLES = ("flexion", "adduction", "rotation", "plane", "elevation", "bending")
"""Names of anatomical angles. A joint has three of these angles."""
_Q_SEGMENT_BODY = (sqrt(0.5), 0.0, 0.0, sqrt(0.5))
"""Rotation from the axes of ROS to the axes of a segment, scalar first: +90 degrees about z."""


class Stamp(NamedTuple):
    """Time stamp in UNIX time."""

    sec: int
    nanosec: int


class JointAngles(NamedTuple):
    """Content of ``sensor_msgs/JointState``."""

    stamp: Stamp
    names: list[str]
    positions: list[float]
    """Joint angles, rad."""
    velocities: list[float]
    """Angular rates, rad/s; empty if a rate is unknown."""


class SegmentTransform(NamedTuple):
    """Content of ``geometry_msgs/TransformStamped``."""

    stamp: Stamp
    parent: str
    child: str
    translation: tuple[float, float, float]
    """Origin of the segment, its proximal joint centre, in the world, m."""
    rotation: tuple[float, float, float, float]
    """Rotation from body to world, (x, y, z, w)."""


def stamp_of(pose: dict[str, Any]) -> Stamp:
    """Return the time stamp of a pose."""
    seconds, microseconds = divmod(pose["t_us"], 1_000_000)
    return Stamp(seconds, 1000 * microseconds)


def joint_angles(pose: dict[str, Any]) -> JointAngles:
    """Return the known angles of all joints, with names ``JOINT_ANGLE`` such as ``knee_flexion``.

    Signs are anatomical (flexion is positive) and may differ from those of a robot model. Unknown
    angles are omitted, because ``JointState`` cannot represent them.
    """
    names, positions, rates = [], [], []
    for joint, values in pose["joints"].items():
        for angle in ANGLES:
            value = values.get(f"{angle}_deg")
            if value is not None:
                names.append(f"{joint}_{angle}")
                positions.append(radians(value))
                rates.append(values.get(f"{angle}_deg_s"))
    known = [radians(rate) for rate in rates if rate is not None]
    return JointAngles(stamp_of(pose), names, positions, known if len(known) == len(rates) else [])


def segment_origins(info: dict[str, Any]) -> dict[str, str]:
    """Return the joint at the origin of every segment, from ``bridge/info``."""
    joints, segments = info["joints"], info["segments"]
    connections = info.get("connections")
    if not connections:
        return dict(zip(segments, joints, strict=False))
    by_child = {one["child"]: joint for joint, one in connections.items()}
    return {segment: by_child.get(segment, joints[0]) for segment in segments}


def segment_transforms(
    pose: dict[str, Any], origins: dict[str, str], world: str = "world"
) -> list[SegmentTransform]:
    """Return the transforms of the segments whose orientation and origin are known.

    Parameters
    ----------
    pose
        Payload of ``pose`` or ``pose/ui``.
    origins
        Joint at the origin of every segment.
    world
        Name of the fixed frame.
    """
    found = []
    for name, segment in pose["segments"].items():
        joint = pose["joints"].get(origins.get(name, ""), {})
        q, origin = segment["q"], joint.get("p_m")
        if q is None or origin is None or None in q or None in origin:
            continue
        w, x, y, z = _product(tuple(q), _Q_SEGMENT_BODY)
        x_m, y_m, z_m = origin
        found.append(SegmentTransform(stamp_of(pose), world, name, (x_m, y_m, z_m), (x, y, z, w)))
    return found


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Return the unit quaternion a ⊗ b, scalar first."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    q = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    w, x, y, z = q
    norm = sqrt(w * w + x * x + y * y + z * z)  # payloads have only five decimals
    return (w / norm, x / norm, y / norm, z / norm)
