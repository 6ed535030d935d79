"""NatNet MODELDEF: the descriptions of the ids in frames, as sent.

    i32 n, then n x { i32 type, [>= 4.1: i32 bytes], description }

From 4.1, the byte size allows every description to be skipped, known or not. In older versions
an unknown type ends the decoding: earlier descriptions are returned, and
`ModelDefinition.complete` is false. Only one client documents the quaternion that some 4.2
descriptions have behind the offset; the size of the description decides whether it is present.

Source: NaturalPoint NatNet SDK 4.1, NatNetTypes.h and PythonClient.
"""

from __future__ import annotations

import struct
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet._cursor import BREAKS, I32, XYZ, Cursor, MalformedError
from jointfit_protocols.natnet._frame import SIZED, Position, Version, supported

if TYPE_CHECKING:
    from collections.abc import Callable

MARKER_SET, RIGID_BODY, SKELETON, FORCE_PLATE, DEVICE, CAMERA, ASSET = range(7)

QUATERNION_LAYOUT = struct.Struct("<4f")
PLATE_LAYOUT = struct.Struct("<2f3f144f12f2i")
CAMERA_LAYOUT = struct.Struct("<3f4f")
ASSET_MARKER_LAYOUT = struct.Struct("<i3ffh")
BODY_HEAD_LAYOUT = struct.Struct("<ii3f")
NAMES_FROM: Version = (4, 0)
"""First bitstream whose body descriptions contain marker names."""

_SMALLEST = 8  # type and size, or type and the shortest description


class MarkerSetDescription(NamedTuple):
    """Names of the markers of one set, in the order of its positions in the frames."""

    name: str
    markers: tuple[str, ...]


class BodyDescription(NamedTuple):
    """One rigid body, or one bone of a skeleton."""

    name: str
    id: int
    """Streaming id, editable by the operator: two bodies may have the same one."""
    parent: int = -1
    offset: Position = (0.0, 0.0, 0.0)
    """Already applied to the streamed pose: not to be added."""
    positions: tuple[Position, ...] = ()
    """Markers in the body, m."""
    labels: tuple[int, ...] = ()
    """Active labels of the markers, 0 for passive ones."""
    markers: tuple[str, ...] = ()
    """Marker names, from 4.0."""
    rotation: tuple[float, float, float, float] | None = None
    """Offset quaternion x, y, z, w if the server sends one (some 4.2)."""


class SkeletonDescription(NamedTuple):
    """One skeleton; a bone's pose has id ``skeleton << 16 | bone`` in the frames."""

    name: str
    id: int
    bones: tuple[BodyDescription, ...]


class PlateDescription(NamedTuple):
    """One force plate, its numbers as sent."""

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
    """One trained marker set (from 4.1)."""

    name: str
    type: int
    id: int
    bodies: tuple[BodyDescription, ...]
    markers: tuple[AssetMarkerDescription, ...]


class UnknownDescription(NamedTuple):
    """A description skipped by its size (from 4.1)."""

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
    """All descriptions of one server, in its order."""

    descriptions: tuple[Description, ...]
    complete: bool = True
    """False if an unknown type ended the decoding (below 4.1)."""


def decode_model(datagram: bytes, version: Version) -> ModelDefinition | CorruptBytes:
    """Return the descriptions in a whole MODELDEF datagram (header included); never raises."""
    if not supported(version):
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
        description = _read_window(cursor, size, kind, version)
        found.append(description or UnknownDescription(kind, cursor.data[at : cursor.at]))
    return ModelDefinition(tuple(found))


def _read_window(cursor: Cursor, size: int, kind: int, version: Version) -> Description | None:
    """Read one description of `size` bytes, with or without the 4.2 quaternion."""
    at = cursor.at
    found: Description | None = None
    for rotated in (False, True):
        cursor.at = at
        reader = _Reader(cursor, version, rotated)
        found = cursor.window(size, partial(reader.description, kind))
        if found is not None:
            break
    return found


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
    """Reads descriptions of one version, with or without the offset quaternion."""

    def __init__(self, cursor: Cursor, version: Version, rotated: bool) -> None:
        self._cursor = cursor
        self._named = version >= NAMES_FROM
        self._rotated = rotated
        self._readers: dict[int, Callable[[], Description]] = {
            MARKER_SET: self._marker_set,
            RIGID_BODY: self._body,
            SKELETON: self._skeleton,
            FORCE_PLATE: self._plate,
            DEVICE: self._device,
            CAMERA: self._camera,
            ASSET: self._asset,
        }

    def description(self, kind: int) -> Description | None:
        """Read a description of type `kind`; None if the type is unknown."""
        read = self._readers.get(kind)
        return None if read is None else read()

    def _marker_set(self) -> MarkerSetDescription:
        return MarkerSetDescription(self._cursor.text(), self._cursor.texts())

    def _body(self) -> BodyDescription:
        cursor = self._cursor
        name = cursor.text()
        number, parent, *offset = cursor.unpack(BODY_HEAD_LAYOUT)
        rotation: Any = cursor.unpack(QUATERNION_LAYOUT) if self._rotated else None
        n = cursor.count(XYZ.size + I32.size)

        positions = tuple(cursor.records(XYZ, n))
        labels = tuple(label for (label,) in cursor.records(I32, n))
        if self._named:
            cursor.check(n, 1)
        names = tuple(cursor.text() for _ in range(n)) if self._named else ()

        x, y, z = offset
        return BodyDescription(
            name,
            number,
            parent,
            (x, y, z),
            positions,
            labels,
            names,
            rotation,
        )

    def _skeleton(self) -> SkeletonDescription:
        return SkeletonDescription(self._cursor.text(), self._cursor.integer(), self._bodies())

    def _bodies(self) -> tuple[BodyDescription, ...]:
        smallest = 1 + BODY_HEAD_LAYOUT.size + I32.size
        return tuple(self._body() for _ in range(self._cursor.count(smallest)))

    def _plate(self) -> PlateDescription:
        cursor = self._cursor
        number, serial = cursor.integer(), cursor.text()
        return PlateDescription(number, serial, cursor.unpack(PLATE_LAYOUT), cursor.texts())

    def _device(self) -> DeviceDescription:
        cursor = self._cursor
        return DeviceDescription(
            cursor.integer(),
            cursor.text(),
            cursor.text(),
            cursor.integer(),
            cursor.integer(),
            cursor.texts(),
        )

    def _camera(self) -> CameraDescription:
        name = self._cursor.text()
        x, y, z, qx, qy, qz, qw = self._cursor.unpack(CAMERA_LAYOUT)
        return CameraDescription(name, (x, y, z), (qx, qy, qz, qw))

    def _asset(self) -> AssetDescription:
        cursor = self._cursor
        name, kind, number = cursor.text(), cursor.integer(), cursor.integer()
        bodies = self._bodies()
        n = cursor.count(1 + ASSET_MARKER_LAYOUT.size)
        return AssetDescription(name, kind, number, bodies, tuple(map(self._marker, range(n))))

    def _marker(self, _: int) -> AssetMarkerDescription:
        name = self._cursor.text()
        number, x, y, z, size, params = self._cursor.unpack(ASSET_MARKER_LAYOUT)
        return AssetMarkerDescription(name, number, (x, y, z), size, params)
