"""Content of an OpenSim file as plain data in its own axes: bodies, joints, frames, markers.

Only names, numbers and frames are interpreted. A document type declaration is rejected before any
expansion. XML entities can therefore neither expand nor refer to other files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET
from xml.parsers import expat

import numpy as np

from jointfit_daemon.files.text import MalformedFileError, reject_device

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

LARGEST = 64 << 20
"""Largest size of a model file, bytes."""
GROUND = "ground"
_OPENSIM_4 = 40000
"""Smallest attribute ``Version`` of an OpenSim 4 document."""
_METRES = "meters"


@dataclass(frozen=True, slots=True)
class OffsetFrame:
    """A frame fixed to a body."""

    body: str
    transform: Array
    """Transform from frame axes to body axes, shape (4, 4)."""


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One generalized coordinate."""

    name: str
    default: float
    low: float
    high: float
    locked: bool


@dataclass(frozen=True, slots=True)
class OsimJoint:
    """A joint as written in the file."""

    name: str
    kind: str
    """XML tag of the joint, such as CustomJoint or PinJoint."""
    parent: OffsetFrame
    child: OffsetFrame
    coordinates: tuple[Coordinate, ...]
    spatial: ET.Element | None
    """Element SpatialTransform of a CustomJoint; None for other joints."""


@dataclass(frozen=True, slots=True)
class OsimMarker:
    """A marker as written in the file."""

    name: str
    body: str
    location: Array
    """Position in the axes of the body, m, shape (3,)."""
    fixed: bool


@dataclass(frozen=True, slots=True)
class OsimDocument:
    """Content of a model file."""

    name: str
    bodies: tuple[str, ...]
    joints: tuple[OsimJoint, ...]
    markers: tuple[OsimMarker, ...]
    constraints: tuple[str, ...]
    """Names of the enforced constraints."""


def read_document(path: Path) -> OsimDocument:
    """Return the content of an ``.osim`` file of OpenSim 4.

    Raises
    ------
    MalformedFileError
        The file is no OpenSim 4 model, contains invalid XML, a document type declaration or a unit
        of length other than metres, or is larger than `LARGEST`.
    """
    root = read_xml(path)
    model = root.find("Model")
    if root.tag != "OpenSimDocument" or model is None:
        inside = f" with <{root[0].tag}>" if len(root) and root.tag == "OpenSimDocument" else ""
        raise MalformedFileError(
            f"{path}, line {line_of(root)}: not an OpenSim model: found <{root.tag}>{inside}, "
            "expected <OpenSimDocument> with a <Model>: choose the .osim file of the model, or "
            "save the model from OpenSim 4 again"
        )
    if model.find("JointSet") is None:
        version = root.get("Version", "")
        if version.isdecimal() and int(version) >= _OPENSIM_4:
            raise MalformedFileError(
                f"{path}: the model has no <JointSet>, expected bodies and joints: export the "
                "whole model from OpenSim"
            )
        raise MalformedFileError(
            f"{path}: written by OpenSim before 4.0: open it in OpenSim 4, and save it again"
        )

    unit = text_of(model, "length_units", _METRES)
    if unit != _METRES:
        raise MalformedFileError(f"{path}: length_units is {unit!r}, expected {_METRES!r}")
    markers = []
    try:
        for marker in model.iterfind("MarkerSet/objects/Marker"):
            socket = text_of(marker, "socket_parent_frame") or text_of(marker, "body")
            location = numbers_of(marker, "location", 3)
            fixed = text_of(marker, "fixed") == "true"
            markers.append(OsimMarker(marker.get("name", ""), body_of(socket), location, fixed))
        return OsimDocument(
            model.get("name", path.stem),
            tuple(body.get("name", "") for body in model.iterfind("BodySet/objects/Body")),
            tuple(_joint(joint) for joint in model.iterfind("JointSet/objects/*")),
            tuple(markers),
            tuple(
                constraint.get("name", constraint.tag)
                for constraint in model.iterfind("ConstraintSet/objects/*")
                if text_of(constraint, "isEnforced", "true") == "true"
            ),
        )
    except (KeyError, ValueError) as error:
        raise MalformedFileError(f"{path}: {error}") from error


def read_xml(path: Path) -> ET.Element:
    """Return the root of an XML file; raise `MalformedFileError` if it has a document type."""
    reject_device(path)
    if path.stat().st_size > LARGEST:
        raise MalformedFileError(
            f"{path}: more than {LARGEST} bytes, which no model has: check the path"
        )
    data = path.read_bytes()
    builder = ET.TreeBuilder(element_factory=_LocatedElement)
    parser = expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise MalformedFileError(
            f"{path}: has a document type declaration, which no OpenSim file has: save the model"
            " from OpenSim again"
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = builder.start(tag, attributes)
        if isinstance(element, _LocatedElement):
            element.line = parser.CurrentLineNumber

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise MalformedFileError(
            f"{path}: not XML, or cut off, at line {error.lineno}, column {error.offset}: save the"
            " model from OpenSim again"
        ) from error
    except MalformedFileError:
        raise
    except (ValueError, LookupError) as error:  # the encoding is unknown to Python
        raise MalformedFileError(
            f"{path}: unknown text encoding: save the file as UTF-8"
        ) from error
    return builder.close()


class _LocatedElement(ET.Element):
    """An XML element with the number of its first line."""

    line = 0


def line_of(element: ET.Element) -> int:
    """Return the line of the beginning of an element from `read_xml`."""
    return element.line if isinstance(element, _LocatedElement) else 0


def text_of(element: ET.Element, tag: str, default: str = "") -> str:
    """Return the stripped text of a child element, or `default`."""
    return (element.findtext(tag) or default).strip()


def numbers_of(element: ET.Element, tag: str, count: int | None = None) -> Array:
    """Return the numbers in a child's text; raise `ValueError` unless there are `count`."""
    try:
        values = np.array([float(cell) for cell in text_of(element, tag).split()])
    except ValueError:
        values = None
    if values is None or (
        count is not None and (values.size != count or not np.isfinite(values).all())
    ):
        name, found = element.get("name", element.tag), element.find(tag)
        number = "" if count is None else f"{count} "
        expected = "one number" if count == 1 else f"{number}numbers with blanks between them"
        raise ValueError(
            f"line {line_of(element if found is None else found)}: {element.tag} {name!r}: {tag} "
            f"is {text_of(element, tag)!r}, expected {expected}: correct it in this line, or save "
            "the file from OpenSim again"
        )
    return values


def body_of(socket: str) -> str:
    """Return the last part of a path such as ``/bodyset/femur_r``."""
    return socket.strip().rpartition("/")[2]


def fixed_xyz(angles: Array) -> Array:
    """Return the matrix (3, 3) of rotations by `angles`, rad, about x, then new y, then new z."""
    turns = []
    for axis, angle in enumerate(angles):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[j, j] = turn[k, k] = np.cos(angle)
        turn[k, j] = np.sin(angle)
        turn[j, k] = -turn[k, j]
        turns.append(turn)
    return np.asarray(turns[0] @ turns[1] @ turns[2])


def _joint(joint: ET.Element) -> OsimJoint:
    frames = {frame.get("name", ""): frame for frame in joint.iterfind("frames/*")}
    return OsimJoint(
        joint.get("name", joint.tag),
        joint.tag,
        _frame(text_of(joint, "socket_parent_frame"), frames),
        _frame(text_of(joint, "socket_child_frame"), frames),
        tuple(_coordinate(c) for c in joint.iterfind("coordinates/Coordinate")),
        joint.find("SpatialTransform"),
    )


def _frame(socket: str, frames: dict[str, ET.Element]) -> OffsetFrame:
    transform, name = np.eye(4), body_of(socket)
    for _ in range(len(frames) + 1):  # frames may be nested, but not in a cycle
        if name not in frames:
            return OffsetFrame(name, transform)
        frame, step = frames[name], np.eye(4)
        step[:3, :3] = fixed_xyz(numbers_of(frame, "orientation", 3))
        step[:3, 3] = numbers_of(frame, "translation", 3)
        transform = step @ transform
        name = body_of(text_of(frame, "socket_parent"))
    raise ValueError(f"frame {socket!r} is defined relative to itself")


def _coordinate(coordinate: ET.Element) -> Coordinate:
    low, high = (
        numbers_of(coordinate, "range", 2)
        if coordinate.find("range") is not None
        else (-np.pi, np.pi)
    )
    locked = "true" in {text_of(coordinate, "locked"), text_of(coordinate, "prescribed")}
    default = 0.0
    if coordinate.find("default_value") is not None:
        (default,) = numbers_of(coordinate, "default_value", 1).tolist()
    return Coordinate(coordinate.get("name", ""), default, float(low), float(high), locked)
