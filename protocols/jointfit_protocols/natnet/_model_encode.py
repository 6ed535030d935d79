"""Encoder of NatNet MODELDEF, for simulators and tests.

Invariant: a model of a real server that `decode_model` has decoded is encoded byte for byte.
"""

from __future__ import annotations

import struct

from jointfit_protocols.natnet._cursor import I32, XYZ, put_text, put_texts
from jointfit_protocols.natnet._frame import SIZED, Version, supported
from jointfit_protocols.natnet._model import (
    ASSET,
    ASSET_MARKER_LAYOUT,
    BODY_HEAD_LAYOUT,
    CAMERA,
    CAMERA_LAYOUT,
    DEVICE,
    FORCE_PLATE,
    MARKER_SET,
    NAMES_FROM,
    PLATE_LAYOUT,
    QUATERNION_LAYOUT,
    RIGID_BODY,
    SKELETON,
    AssetDescription,
    BodyDescription,
    CameraDescription,
    Description,
    DeviceDescription,
    MarkerSetDescription,
    ModelDefinition,
    PlateDescription,
    SkeletonDescription,
)

_TWO = struct.Struct("<ii")


def encode_model(model: ModelDefinition, version: Version) -> bytes:
    """Return the payload (without message header) of `model` in bitstream `version`.

    Raises
    ------
    ValueError
        The bitstream is older than 3.0, or a description does not exist in it.
    """
    if not supported(version):
        raise ValueError(f"bitstream {version[0]}.{version[1]} is not written")
    parts = [I32.pack(len(model.descriptions))]
    for description in model.descriptions:
        kind, body = _put(description, version)
        parts.append(_TWO.pack(kind, len(body)) if version >= SIZED else I32.pack(kind))
        parts.append(body)
    return b"".join(parts)


def _put(description: Description, version: Version) -> tuple[int, bytes]:  # noqa: PLR0911 - one case a type
    match description:
        case MarkerSetDescription():
            return MARKER_SET, put_text(description.name) + put_texts(description.markers)
        case BodyDescription():
            return RIGID_BODY, _put_body(description, version)
        case SkeletonDescription():
            head = put_text(description.name) + I32.pack(description.id)
            return SKELETON, head + _put_bodies(description.bones, version)
        case PlateDescription():
            return FORCE_PLATE, _put_plate(description)
        case DeviceDescription():
            return DEVICE, _put_device(description)
        case CameraDescription():
            place = CAMERA_LAYOUT.pack(*description.position, *description.quaternion)
            return CAMERA, put_text(description.name) + place
        case AssetDescription():
            return ASSET, _put_asset(description, version)
        case _:
            if version < SIZED:
                raise ValueError("an unknown description has no size before 4.1")
            return description.type, description.data


def _put_body(body: BodyDescription, version: Version) -> bytes:
    head = BODY_HEAD_LAYOUT.pack(body.id, body.parent, *body.offset)
    rotation = b"" if body.rotation is None else QUATERNION_LAYOUT.pack(*body.rotation)
    n = len(body.positions)
    if len(body.labels) != n or (version >= NAMES_FROM and len(body.markers) != n):
        raise ValueError(f"{body.name}: as many labels and names as markers are needed")
    markers = [XYZ.pack(*position) for position in body.positions]
    labels = [I32.pack(label) for label in body.labels]
    names = [put_text(name) for name in body.markers] if version >= NAMES_FROM else []
    return b"".join((put_text(body.name), head, rotation, I32.pack(n), *markers, *labels, *names))


def _put_bodies(bodies: tuple[BodyDescription, ...], version: Version) -> bytes:
    return I32.pack(len(bodies)) + b"".join(_put_body(body, version) for body in bodies)


def _put_plate(plate: PlateDescription) -> bytes:
    head = I32.pack(plate.id) + put_text(plate.serial)
    return head + PLATE_LAYOUT.pack(*plate.numbers) + put_texts(plate.channels)


def _put_device(device: DeviceDescription) -> bytes:
    names = put_text(device.name) + put_text(device.serial)
    kinds = _TWO.pack(device.type, device.data_type)
    return I32.pack(device.id) + names + kinds + put_texts(device.channels)


def _put_asset(asset: AssetDescription, version: Version) -> bytes:
    if version < SIZED:
        raise ValueError("assets exist from bitstream 4.1 on")
    head = put_text(asset.name) + _TWO.pack(asset.type, asset.id)
    markers = [
        put_text(m.name) + ASSET_MARKER_LAYOUT.pack(m.id, *m.position, m.size, m.params)
        for m in asset.markers
    ]
    bodies = _put_bodies(asset.bodies, version)
    return head + bodies + I32.pack(len(markers)) + b"".join(markers)
