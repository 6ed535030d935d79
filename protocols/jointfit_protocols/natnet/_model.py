"""NatNet MODELDEF: descriptions of the ids that frames contain, as sent.

    i32 n, then n x { i32 type, [>= 4.1: i32 bytes], description }

From bitstream 4.1 on, every description can be skipped by its size, even if its type is unknown. In
older bitstreams, an unknown type ends the decoding. The earlier descriptions are returned, and
`ModelDefinition.complete` is false. Some 4.2 servers send a quaternion after the offset, which only
one client documents. The size of the description shows whether it is present.

Source: NaturalPoint NatNet SDK 4.1, NatNetTypes.h and PythonClient.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet._cursor import BREAKS, I32, XYZ, Cursor, MalformedError
from jointfit_protocols.natnet._frame import SIZED, TICKED, Position, Version, is_supported


class DescriptionType(IntEnum):
    """Type of a description, which is its first field."""

    MARKER_SET = 0
    RIGID_BODY = 1
    SKELETON = 2
    FORCE_PLATE = 3
    DEVICE = 4
    CAMERA = 5
    ASSET = 6


QUATERNION_LAYOUT = struct.Struct("<4f")
PLATE_LAYOUT = struct.Struct("<2f3f144f12f2i")
CAMERA_LAYOUT = struct.Struct("<3f4f")
ASSET_MARKER_LAYOUT = struct.Struct("<i3ffh")
BODY_HEAD_LAYOUT = struct.Struct("<ii3f")
NAMES_FROM: Version = (4, 0)
"""First bitstream whose body descriptions contain marker names."""

_SMALLEST = 8  # bytes: type and size, or type and the shortest description


class MarkerSetDescription(NamedTuple):
    """Names of the markers in one set, in the order of the positions in the frames."""

    name: str
    markers: tuple[str, ...]


class BodyDescription(NamedTuple):
    """One rigid body, or one bone of a skeleton."""

    name: str
    id: int
    """Streaming id. The operator can edit it, so two bodies may have the same id."""
    parent: int = -1
    offset: Position = (0.0, 0.0, 0.0)
    """Offset that the server has already applied to the pose. The offset must not be added
    again."""
    positions: tuple[Position, ...] = ()
    """Positions of the markers in the body, m."""
    labels: tuple[int, ...] = ()
    """Active labels of the markers; 0 for passive markers."""
    markers: tuple[str, ...] = ()
    """Names of the markers (bitstream 4.0 and later)."""
    rotation: tuple[float, float, float, float] | None = None
    """Offset quaternion x, y, z, w; None if the server sends none. Some servers of version 4.2 send
    it."""


class SkeletonDescription(NamedTuple):
    """One skeleton. In the frames, the pose of a bone has the id ``skeleton << 16 | bone``."""

    name: str
    id: int
    bones: tuple[BodyDescription, ...]


class PlateDescription(NamedTuple):
    """One force plate, with the numbers as sent."""

    id: int
    serial: str
    numbers: tuple[float, ...]
    """Width, length, origin (3), calibration (144), corners (12), type, channel data type."""
    channels: tuple[str, ...]


class DeviceDescription(NamedTuple):
    """One analog device."""

    id: int
    name: str
    serial: str
    type: int
    data_type: int
    channels: tuple[str, ...]


class CameraDescription(NamedTuple):
    """One camera: position, m, and quaternion x, y, z, w."""

    name: str
    position: Position
    quaternion: tuple[float, float, float, float]


class AssetMarkerDescription(NamedTuple):
    """One marker of an asset."""

    name: str
    id: int
    position: Position
    size: float
    params: int


class AssetDescription(NamedTuple):
    """One trained marker set (bitstream 4.1 and later)."""

    name: str
    type: int
    id: int
    bodies: tuple[BodyDescription, ...]
    markers: tuple[AssetMarkerDescription, ...]


class UnknownDescription(NamedTuple):
    """A description that was skipped by its size (bitstream 4.1 and later)."""

    type: int
    data: bytes


Description = (
    MarkerSetDescription
    | BodyDescription
    | SkeletonDescription
    | PlateDescription
    | DeviceDescription
    | CameraDescription
    | AssetDescription
    | UnknownDescription
)


class ModelDefinition(NamedTuple):
    """All descriptions of one server in the order of sending."""

    descriptions: tuple[Description, ...]
    complete: bool = True
    """Whether all descriptions were read. False means that an unknown type ended the decoding,
    which is possible below bitstream 4.1."""


def decode_model(datagram: bytes, version: Version) -> ModelDefinition | CorruptBytes:
    """Return the descriptions in a complete MODELDEF datagram with header; never raise."""
    if not is_supported(version):
        return CorruptBytes(
            len(datagram), f"NatNet bitstream {version[0]}.{version[1]} is not supported"
        )

    cursor = Cursor(datagram, 4)
    try:
        n = cursor.count(_SMALLEST)
        found = _read_sized(cursor, n, version) if version >= SIZED else _read(cursor, n, version)
        if found.complete and cursor.left:
            raise MalformedError(f"{cursor.left} bytes behind the last description")
    except BREAKS as problem:
        return CorruptBytes(len(datagram), f"model: {problem}")
    return found


def _read_sized(cursor: Cursor, n: int, version: Version) -> ModelDefinition:
    found: list[Description] = []
    for _ in range(n):
        kind, size = cursor.integer(), cursor.integer()
        at = cursor.at
        description: Description | None = None

        # The size shows whether the quaternion of some 4.2 servers is present.
        for rotated in (False, True):
            if description is None:
                cursor.at = at
                reader = _Reader(cursor, version, rotated)
                description = cursor.window(size, partial(reader.description, kind))
        found.append(description or UnknownDescription(kind, cursor.data[at : cursor.at]))
    return ModelDefinition(tuple(found))


def _read(cursor: Cursor, n: int, version: Version) -> ModelDefinition:
    reader = _Reader(cursor, version, rotated=False)
    found: list[Description] = []
    for _ in range(n):
        description = reader.description(cursor.integer())
        if description is None:
            return ModelDefinition(tuple(found), complete=False)
        found.append(description)
    return ModelDefinition(tuple(found))


class _Reader:
    """Reads descriptions of one bitstream version, with or without the offset quaternion."""

    def __init__(self, cursor: Cursor, version: Version, rotated: bool) -> None:
        self._cursor = cursor
        self._marked = version >= TICKED
        self._named = version >= NAMES_FROM
        self._rotated = rotated

    def description(self, kind: int) -> Description | None:  # noqa: PLR0911 - one case per type
        """Read a description of type `kind`; None if the type is unknown."""
        cursor = self._cursor
        text, integer = cursor.text, cursor.integer
        match kind:
            case DescriptionType.MARKER_SET:
                return MarkerSetDescription(text(), cursor.texts())
            case DescriptionType.RIGID_BODY:
                return self._body()
            case DescriptionType.SKELETON:
                return SkeletonDescription(text(), integer(), self._bodies())
            case DescriptionType.FORCE_PLATE:
                return PlateDescription(
                    integer(), text(), cursor.unpack(PLATE_LAYOUT), cursor.texts()
                )
            case DescriptionType.DEVICE:
                return DeviceDescription(
                    integer(), text(), text(), integer(), integer(), cursor.texts()
                )
            case DescriptionType.CAMERA:
                name, (x, y, z, *quaternion) = text(), cursor.unpack(CAMERA_LAYOUT)
                return CameraDescription(name, (x, y, z), tuple(quaternion))
            case DescriptionType.ASSET:
                name, type_, number, bodies = text(), integer(), integer(), self._bodies()
                n = cursor.count(1 + ASSET_MARKER_LAYOUT.size)
                markers = tuple(self._marker() for _ in range(n))
                return AssetDescription(name, type_, number, bodies, markers)
        return None

    def _body(self) -> BodyDescription:
        cursor = self._cursor
        name = cursor.text()
        number, parent, *offset = cursor.unpack(BODY_HEAD_LAYOUT)
        if not self._marked:
            return BodyDescription(name, number, parent, (offset[0], offset[1], offset[2]))
        rotation: Any = cursor.unpack(QUATERNION_LAYOUT) if self._rotated else None
        n = cursor.count(XYZ.size + I32.size)

        positions = tuple(cursor.records(XYZ, n))
        labels = tuple(label for (label,) in cursor.records(I32, n))
        if self._named:
            cursor.check(n, 1)
        names = tuple(cursor.text() for _ in range(n)) if self._named else ()

        x, y, z = offset
        return BodyDescription(name, number, parent, (x, y, z), positions, labels, names, rotation)

    def _bodies(self) -> tuple[BodyDescription, ...]:
        smallest = 1 + BODY_HEAD_LAYOUT.size + I32.size * self._marked
        return tuple(self._body() for _ in range(self._cursor.count(smallest)))

    def _marker(self) -> AssetMarkerDescription:
        name = self._cursor.text()
        number, x, y, z, size, params = self._cursor.unpack(ASSET_MARKER_LAYOUT)
        return AssetMarkerDescription(name, number, (x, y, z), size, params)
