"""Chain model of a simulated subject, in TOML and OpenSim 4 format.

Invariant: both files describe the same model. The markers of thigh, shank and foot have errors of
about a centimetre, as in a scaled model. The markers of the pelvis are exact, and two of them are
locked.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._limb import LegGeometry

LOCKED = ("P1", "P2")
"""Markers whose positions the simultaneous refinement may not change."""
MISPLACED_M = 0.006
"""Standard deviation of each coordinate of a misplaced marker, m."""
_EXACT_PARTS = ("pelvis",)
"""Segments with exact markers."""
_FLEXION_RAD = (-2.4, 0.1)
"""Range of the angle of the knee hinge about the axis to the right, rad."""
Vector = tuple[float, float, float]


class Part(NamedTuple):
    """One segment, with the joint that connects it to its parent."""

    name: str
    parent: str | None
    kind: str
    center_in_parent: Vector


class SampleMarker(NamedTuple):
    """One marker of the model, with its position in the segment frame (z up, x right), m."""

    name: str
    segment: str
    position: Vector


def leg_parts(geometry: LegGeometry) -> list[Part]:
    """Return pelvis, thigh, shank and foot. The knee is a hinge."""
    return [
        Part("pelvis", None, "free", (0.0, 0.0, 0.0)),
        Part("thigh", "pelvis", "ball", geometry.hip_in_pelvis),
        Part("shank", "thigh", "hinge", (0.0, 0.0, -geometry.thigh_m)),
        Part("foot", "shank", "ball", (0.0, 0.0, -geometry.shank_m)),
    ]


def misplaced_markers(
    random: np.random.Generator,
    clusters: Mapping[str, Sequence[str]],
    templates: Mapping[str, Array],
    parts: Sequence[Part],
) -> list[SampleMarker]:
    """Return the markers of `parts`; all except the pelvis markers are displaced at random."""
    markers = []
    for part in parts:
        true = templates[part.name]
        off = random.normal(0.0, MISPLACED_M, true.shape) * (part.name not in _EXACT_PARTS)
        for name, (x, y, z) in zip(clusters[part.name], (true + off).tolist(), strict=True):
            markers.append(SampleMarker(name, part.name, (round(x, 4), round(y, 4), round(z, 4))))
    return markers


def model_toml(parts: Sequence[Part], markers: Sequence[SampleMarker]) -> str:
    """Return the model as a chain model file."""
    lines = ['name = "sample leg"']

    for part in parts:
        lines += ["", "[[segment]]", f'name = "{part.name}"']
        if part.parent is not None:
            lines += [f'parent = "{part.parent}"', f'joint = "{part.kind}"']
            lines += [f"center_in_parent = {list(part.center_in_parent)}"]
        if part.kind == "hinge":
            lines += ["axis = [1.0, 0.0, 0.0]", f"limits = {list(_FLEXION_RAD)}"]

    for marker in markers:
        lines += ["", "[[marker]]", f'name = "{marker.name}"', f'segment = "{marker.segment}"']
        lines += [f"position = {list(marker.position)}"]
        lines += ['locked = "xyz"'] if marker.name in LOCKED else []
    return "\n".join(lines) + "\n"


_OSIM_JOINTS = {"free": "FreeJoint", "ball": "BallJoint", "hinge": "PinJoint"}
_COORDINATES = {"free": 6, "ball": 3, "hinge": 1}


def model_osim(parts: Sequence[Part], markers: Sequence[SampleMarker]) -> str:
    """Return the model as an OpenSim 4 file (x forward, y up, z right)."""
    document = ET.Element("OpenSimDocument", Version="40000")
    model = ET.SubElement(document, "Model", name="sample_leg")
    ET.SubElement(model, "Ground", name="ground")
    ET.SubElement(model, "length_units").text = "meters"

    bodies = _objects(model, "BodySet")
    joints = _objects(model, "JointSet")
    for part in parts:
        body = ET.SubElement(bodies, "Body", name=part.name)
        ET.SubElement(body, "mass").text = "1"
        _add_joint(joints, part)

    placed = _objects(model, "MarkerSet")
    for marker in markers:
        one = ET.SubElement(placed, "Marker", name=marker.name)
        ET.SubElement(one, "socket_parent_frame").text = f"/bodyset/{marker.segment}"
        ET.SubElement(one, "location").text = _y_up(marker.position)
        ET.SubElement(one, "fixed").text = str(marker.name in LOCKED).lower()

    ET.indent(document)
    return ET.tostring(document, encoding="unicode", xml_declaration=True) + "\n"


def _objects(model: ET.Element, name: str) -> ET.Element:
    return ET.SubElement(ET.SubElement(model, name), "objects")


def _add_joint(joints: ET.Element, part: Part) -> None:
    joint = ET.SubElement(joints, _OSIM_JOINTS[part.kind], name=f"{part.name}_joint")
    ET.SubElement(joint, "socket_parent_frame").text = "in_parent"
    ET.SubElement(joint, "socket_child_frame").text = "in_child"

    coordinates = ET.SubElement(joint, "coordinates")
    low, high = _FLEXION_RAD if part.kind == "hinge" else (-np.pi, np.pi)
    for number in range(_COORDINATES[part.kind]):
        one = ET.SubElement(coordinates, "Coordinate", name=f"{part.name}_{number}")
        ET.SubElement(one, "range").text = f"{low:.6g} {high:.6g}"

    frames = ET.SubElement(joint, "frames")
    parent = "/ground" if part.parent is None else f"/bodyset/{part.parent}"
    for name, socket, at in (
        ("in_parent", parent, part.center_in_parent),
        ("in_child", f"/bodyset/{part.name}", (0.0, 0.0, 0.0)),
    ):
        frame = ET.SubElement(frames, "PhysicalOffsetFrame", name=name)
        ET.SubElement(frame, "socket_parent").text = socket
        ET.SubElement(frame, "translation").text = _y_up(at)
        ET.SubElement(frame, "orientation").text = "0 0 0"


def _y_up(vector: Vector) -> str:
    """Return a vector (right, forward, up) in OpenSim's axes (forward, up, right)."""
    x, y, z = vector
    return f"{y:g} {z:g} {x:g}"
