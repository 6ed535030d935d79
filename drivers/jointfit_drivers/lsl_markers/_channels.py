"""Assignment of the channels of an LSL stream to marker coordinates and body poses.

The assignment follows the MoCap meta-data of XDF, the file format of LSL. Each channel has a label,
the name of a marker or object, a type (PositionX to Z, OrientationA to D, or Confidence) and a
unit. If the type is missing, the end of the label (``T1_X``, ``Thigh.qw``, ``Thigh_quat_w``)
replaces it. If the channels have no labels, rig.toml defines the labels, or the names of the
markers, each of which has the three channels x, y and z.

The meta-data do not define which of OrientationA to D is the scalar. PhaseSpace sends the scalar
first. The OptiTrack program of LSL sends the scalar last.

Invariant: the functions are pure. An unknown channel is ignored and never guessed. If all channels
are unknown, a warning reports this fact.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.name_lists import list_names
from jointfit_drivers.motion_capture import ModelEntry
from jointfit_protocols.lsl import Channel

if TYPE_CHECKING:
    from jointfit_drivers.lsl_markers._settings import LslMarkersSettings
    from jointfit_drivers.motion_capture import ColumnKey
    from jointfit_protocols.lsl import StreamDescription

_POSITION = {"positionx": "x", "positiony": "y", "positionz": "z"}
_ORIENTATION = {
    f"{word}{letter}": f"q{letter}"
    for word, letters in (("orientation", "abcdwxyz"), ("quaternion", "wxyz"), ("rotation", "wxyz"))
    for letter in letters
}
_EULER = {"orientationp": "euler", "orientationh": "euler", "orientationr": "euler"}
_TYPES = _POSITION | _ORIENTATION | _EULER | {"confidence": "confidence"}
_OTHER_TYPES = ("orient", "quat", "rot", "euler", "vel", "acc", "ang")
"""First letters of the types of channels that contain no position, whatever their label."""
_LABEL = re.compile(
    r"(?P<name>.+?)[\s_.:/-]+"
    r"(?:(?:pos(?:ition)?|(?P<turn>q(?:uat(?:ernion)?)?|rot(?:ation)?|orient(?:ation)?|ornt)"
    r"|(?P<other>euler|vel(?:ocity)?))[\s_.:/-]*)?(?P<part>[wxyz])",
    re.IGNORECASE,
)
_LAST_SCALAR = "naturalpoint"
"""Manufacturer in the streams of the OptiTrack program of LSL. This program sends the quaternion of
a body as x, y, z, w in the channels OrientationA to D."""
_UNITS_M = {
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0,
    "cm": 0.01, "centimeter": 0.01, "centimeters": 0.01, "centimetre": 0.01, "centimetres": 0.01,
    "mm": 0.001, "millimeter": 0.001, "millimeters": 0.001, "millimetre": 0.001,
    "millimetres": 0.001,
}  # fmt: skip
_AXES, _TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
_LISTED = 5
"""Largest number of names in a warning."""


class Columns(NamedTuple):
    """Channel numbers of one marker or body."""

    position: tuple[int, int, int]
    orientation: tuple[int, int, int, int] | None
    confidence: int | None


class StreamLayout(NamedTuple):
    """Meaning of the channels of a stream."""

    markers: tuple[ModelEntry, ...]
    bodies: tuple[ModelEntry, ...]
    columns: dict[ColumnKey, Columns]
    """Channel numbers of each marker or body, by its key."""
    scale_m: float
    """Length of one unit of the positions, m."""
    unit: str
    """``m``, ``cm`` or ``mm``."""
    warnings: tuple[str, ...]


def stream_layout(description: StreamDescription, settings: LslMarkersSettings) -> StreamLayout:
    """Return the meaning of the channels of a stream.

    Parameters
    ----------
    description : StreamDescription
        Description of the stream.
    settings : LslMarkersSettings
        The ``[mocap]`` table.
    """
    warnings: list[str] = []
    if settings.names:
        found = _named_channels(description, settings.names, warnings)
    else:
        channels = _channels(description, settings, warnings)
        order = _quaternion_order(description, settings)
        found = _described_channels(channels, order, warnings)

    owners = {owner: 0 for owner, _, _ in found}
    entries: tuple[list[ModelEntry], list[ModelEntry]] = ([], [])
    columns: dict[ColumnKey, Columns] = {}
    incomplete: list[str] = []
    turned: list[str] = []
    for (owner, name, _), parts in found.items():
        if not all(axis in parts for axis in _AXES):
            incomplete.append(name)
            continue
        whole = all(part in parts for part in _TURN)
        if "euler" in parts or (not whole and any(part in parts for part in _TURN)):
            turned.append(name)
        qw, qx, qy, qz = (parts.get(part, 0) for part in _TURN)
        x, y, z = (parts[axis] for axis in _AXES)
        owners[owner] += 1
        key = len(columns)
        entries[whole].append(ModelEntry(key, owner, name, owners[owner]))
        turn = (qw, qx, qy, qz) if whole else None
        columns[key] = Columns((x, y, z), turn, parts.get("confidence"))

    if incomplete:
        warnings.append(
            f"{list_names(incomplete, _LISTED)} without all three coordinates are not used: stream "
            "x, y and z"
        )
    if turned:
        warnings.append(
            f"rigid bodies {list_names(turned, _LISTED)} have Euler angles, whose order a stream "
            "does not describe, or an incomplete quaternion: they are used as markers; stream "
            "quaternions, or use markers in [mocap]"
        )
    unit = _unit(description, settings, columns, warnings)
    return StreamLayout(
        tuple(entries[0]), tuple(entries[1]), columns, _UNITS_M[unit], unit, tuple(warnings)
    )


_Found = dict[tuple[str, str, bool], dict[str, int]]
"""Channel number of each component. The key contains the object that owns a marker, the name of the
marker or object, and whether the name belongs to an object."""


def _named_channels(
    description: StreamDescription, names: tuple[str, ...], warnings: list[str]
) -> _Found:
    """Return the channels of a stream whose names rig.toml defines."""
    if 3 * len(names) != description.channel_count:
        warnings.append(
            f"names lists {len(names)} markers, which are {3 * len(names)} channels; the stream "
            f"has {description.channel_count}: correct names in [mocap]"
        )
        return {}
    return {
        ("", name, False): dict(zip(_AXES, range(3 * n, 3 * n + 3), strict=True))
        for n, name in enumerate(names)
    }


def _channels(
    description: StreamDescription, settings: LslMarkersSettings, warnings: list[str]
) -> tuple[Channel, ...]:
    """Return the channels as the stream describes them, or with the labels of rig.toml."""
    count = description.channel_count
    if settings.labels:
        if len(settings.labels) == count:
            return tuple(Channel(label) for label in settings.labels)
        warnings.append(
            f"labels lists {len(settings.labels)} channels; the stream has {count}: correct labels "
            "in [mocap]"
        )
    elif not description.channels:
        warnings.append(
            f"the stream describes none of its {count} channels: set names in [mocap] to the "
            "markers in their order, x y z each; or labels to the label of every channel, such as "
            "T1_X or Thigh_qw"
        )
    return () if settings.labels else description.channels


def _quaternion_order(description: StreamDescription, settings: LslMarkersSettings) -> str:
    """Return the components in the channels OrientationA to D, in this order."""
    if settings.quaternion_order != "auto":
        return settings.quaternion_order
    return "xyzw" if description.manufacturer.lower() == _LAST_SCALAR else "wxyz"


def _described_channels(
    channels: tuple[Channel, ...], quaternion_order: str, warnings: list[str]
) -> _Found:
    """Return the channels according to their descriptions in the stream."""
    lettered = {f"q{at}": f"q{part}" for at, part in zip("abcd", quaternion_order, strict=True)}
    found: _Found = {}
    repeated: list[str] = []
    for number, channel in enumerate(channels):
        part = _TYPES.get(channel.type.lower(), "")
        by_label = _LABEL.fullmatch(channel.label)
        if not part and by_label is not None and not channel.type.lower().startswith(_OTHER_TYPES):
            part = _labelled_part(by_label)
        part = lettered.get(part, part)
        name = channel.marker or channel.object
        if not name and by_label is not None:
            name = by_label["name"]
        if not part or not name:
            continue  # a frame number or another channel of the program

        is_object = not channel.marker and bool(channel.object)
        owner = "" if is_object else channel.object
        parts = found.setdefault((owner, name, is_object), {})
        if part in parts and part != "euler":
            repeated.append(f"{name} {part}")
        parts.setdefault(part, number)
    if channels and not found:
        labels = [channel.label or channel.type or "(empty)" for channel in channels]
        warnings.append(
            f"no channel is a coordinate by its type (PositionX) or label (T1_X); found "
            f"{list_names(labels, _LISTED)}: set names in [mocap], or select another stream"
        )
    if repeated:
        warnings.append(
            f"{list_names(repeated, _LISTED)} are described more than once: the first channel is "
            "used; give every marker a name of its own in the camera software"
        )
    return found


def _labelled_part(label: re.Match[str]) -> str:
    """Return the component that the end of a label names; empty for another quantity."""
    if label["other"]:
        return "euler" if label["other"].lower() == "euler" else ""
    part = label["part"].lower()
    if label["turn"]:
        return f"q{part}"
    return part if part != "w" else ""


def _unit(
    description: StreamDescription,
    settings: LslMarkersSettings,
    columns: dict[ColumnKey, Columns],
    warnings: list[str],
) -> str:
    """Return the unit of the positions: the configured unit, the described unit, or else m."""
    if settings.unit != "auto":
        return settings.unit
    described = description.channels
    texts = {
        described[index].unit.lower()
        for one in columns.values()
        if described
        for index in one.position
    }
    lengths = {_UNITS_M[text] for text in texts if text in _UNITS_M}
    if len(lengths) > 1 or (texts - {""} and not lengths):
        warnings.append(
            f"the stream describes positions in {list_names(sorted(texts), _LISTED)}: metres are "
            "assumed; set unit in [mocap]"
        )
        return "m"
    return {1.0: "m", 0.01: "cm", 0.001: "mm"}[lengths.pop()] if lengths else "m"
