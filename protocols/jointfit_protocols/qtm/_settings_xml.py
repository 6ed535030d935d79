"""Settings of a QTM server, parsed from the XML document that answers ``GetParameters``.

From version 1.21 on, the points of a `Body` have attributes instead of elements, and the segments
of a skeleton are nested. Both layouts are supported. The name of a body or marker is read only from
a direct child, because meshes and points also have names. The root element is
``QTM_Parameters_Ver_x.y`` or ``QTM_Settings``.

Invariant: the size of the input is limited, entities are rejected, and no exception is raised. If
the text is not such a document, the result is None.
"""

from __future__ import annotations

from typing import NamedTuple
from xml.etree import ElementTree as ET

_LARGEST = 4 << 20
"""Largest accepted text, characters."""
_LONGEST_NAME = 255
_MOST_DIGITS = 10
_DECLARATIONS = ("<!DOCTYPE", "<!ENTITY")
"""Declarations that QTM settings never contain. Entities could expand to a text of any size."""


class QtmBody(NamedTuple):
    """One 6DOF body."""

    name: str
    enabled: bool = True
    """Whether the body is tracked. Always true below version 1.24, because the element is
    missing."""
    relative: bool = False
    """Whether the pose of the body is relative to another body instead of the world."""
    fixed: bool = False
    """Whether the pose of the body is relative to a fixed pose instead of the world."""
    points: tuple[str, ...] = ()
    """Names of the points of the body; empty texts below version 1.21."""


class QtmSkeleton(NamedTuple):
    """One skeleton."""

    name: str
    segments: tuple[tuple[int, str], ...]
    """Id and name of each segment."""


class QtmSettingsXml(NamedTuple):
    """Parts of the settings. A part that the document lacks is None."""

    frequency_hz: float | None = None
    timestamp_enabled: bool | None = None
    timestamp_type: str | None = None
    """``SMPTE``, ``IRIG`` or camera time, in the spelling of QTM."""
    tracks_bodies: bool | None = None
    """Whether 6DOF bodies are tracked in real time."""
    up_axis: str | None = None
    """Axis that points upwards, such as ``+Z``."""
    calibrated: str | None = None
    """Time of the last calibration; empty if the cameras are not calibrated."""
    labels: tuple[str, ...] | None = None
    """Names of the labeled markers, in the order of the 3D components."""
    bodies: tuple[QtmBody, ...] | None = None
    """6DOF bodies, in the order of the 6D components."""
    skeletons: tuple[QtmSkeleton, ...] | None = None


def parse_settings(text: str) -> QtmSettingsXml | None:
    """Return the settings in an XML document; None if it is not a QTM document."""
    text = text.strip()
    if len(text) > _LARGEST or any(word in text for word in _DECLARATIONS):
        return None
    try:
        root = ET.fromstring(text)  # noqa: S314 - bounded, and without entities
    except (ET.ParseError, ValueError):
        return None
    if not root.tag.startswith(("QTM_Parameters_Ver_", "QTM_Settings")):
        return None

    general, markers = root.find("General"), root.find("The_3D")
    bodies, skeletons = root.find("The_6D"), root.find("Skeletons")
    frequency = None if general is None else _number(_text(general, "Frequency"))
    return QtmSettingsXml(
        frequency_hz=frequency,
        timestamp_enabled=_flag(general, "External_Timestamp/Enabled"),
        timestamp_type=_text(general, "External_Timestamp/Type"),
        tracks_bodies=_flag(general, "RealTime_Processing_Actions/Track6DOF"),
        up_axis=_text(markers, "AxisUpwards"),
        calibrated=_text(markers, "CalibrationTime"),
        labels=None if markers is None else tuple(_names(markers.findall("Label"))),
        bodies=None if bodies is None else tuple(map(_body, bodies.findall("Body"))),
        skeletons=None if skeletons is None else tuple(map(_skeleton, skeletons)),
    )


def _body(body: ET.Element) -> QtmBody:
    points = body.find("Points")
    named = (
        body.findall("Point") if points is None else points.findall("Point")
    )  # below version 1.21, points are elements of the body
    origins = {_text(body, "Data_origin"), _text(body, "Data_orientation")}
    return QtmBody(
        _cut(_text(body, "Name") or ""),
        enabled=_flag(body, "Enabled") is not False,
        relative="1" in origins,
        fixed="2" in origins,
        points=tuple(_cut(point.get("Name", "")) for point in named),
    )


def _skeleton(skeleton: ET.Element) -> QtmSkeleton:
    segments = [
        (int(number), _cut(segment.get("Name", "")))
        for segment in skeleton.iter("Segment")
        if (number := segment.get("ID", "")).isascii()
        and number.isdigit()
        and len(number) < _MOST_DIGITS
    ]
    return QtmSkeleton(_cut(skeleton.get("Name", "")), tuple(segments))


def _names(elements: list[ET.Element]) -> list[str]:
    return [_cut(_text(element, "Name") or "") for element in elements]


def _text(element: ET.Element | None, path: str) -> str | None:
    found = None if element is None else element.find(path)
    return None if found is None else (found.text or "").strip()


def _flag(element: ET.Element | None, path: str) -> bool | None:
    found = _text(element, path)
    return None if not found else found.lower() == "true"


def _number(text: str | None) -> float | None:
    try:
        return float(text or "")
    except ValueError:
        return None


def _cut(name: str) -> str:
    return name[:_LONGEST_NAME]
