"""Encoder of NatNet MODELDEF, for simulators and tests.

Invariant: encoding a model that `decode_model` decoded returns the bytes of the real server.
"""

from __future__ import annotations

from jointfit_protocols.natnet._cursor import I32, XYZ, put_text, put_texts
from jointfit_protocols.natnet._frame import SIZED, TICKED, TWO_LAYOUT, Version, is_supported
from jointfit_protocols.natnet._model import (
    ASSET_MARKER_LAYOUT,
    BODY_HEAD_LAYOUT,
    CAMERA_LAYOUT,
    NAMES_FROM,
    PLATE_LAYOUT,
    QUATERNION_LAYOUT,
    AssetDescription,
    BodyDescription,
    CameraDescription,
    Description,
    DescriptionType,
    DeviceDescription,
    MarkerSetDescription,
    ModelDefinition,
    PlateDescription,
    SkeletonDescription,
)


def encode_model(model: ModelDefinition, version: Version) -> bytes:
    """Return the payload of `model` in bitstream `version`, without the message header.

    Raises
    ------
    ValueError
        The bitstream is older than 2.5, or does not have one of the descriptions.
    """
    if not is_supported(version):
        raise ValueError(f"bitstream {version[0]}.{version[1]} cannot be encoded")
    parts = [I32.pack(len(model.descriptions))]
    for description in model.descriptions:
        kind, body = _put(description, version)
        parts.append(TWO_LAYOUT.pack(kind, len(body)) if version >= SIZED else I32.pack(kind))
        parts.append(body)
    return b"".join(parts)


def _put(description: Description, version: Version) -> tuple[int, bytes]:  # noqa: PLR0911 - one case per type
    match description:
        case MarkerSetDescription():
            names = put_texts(description.markers)
            return DescriptionType.MARKER_SET, put_text(description.name) + names
        case BodyDescription():
            return DescriptionType.RIGID_BODY, _put_body(description, version)
        case SkeletonDescription():
            head = put_text(description.name) + I32.pack(description.id)
            return DescriptionType.SKELETON, head + _put_bodies(description.bones, version)
        case PlateDescription():
            head = I32.pack(description.id) + put_text(description.serial)
            numbers = PLATE_LAYOUT.pack(*description.numbers)
            return DescriptionType.FORCE_PLATE, head + numbers + put_texts(description.channels)
        case DeviceDescription():
            head = I32.pack(description.id) + put_text(description.name)
            head += put_text(description.serial)
            head += TWO_LAYOUT.pack(description.type, description.data_type)
            return DescriptionType.DEVICE, head + put_texts(description.channels)
        case CameraDescription():
            place = CAMERA_LAYOUT.pack(*description.position, *description.quaternion)
            return DescriptionType.CAMERA, put_text(description.name) + place
        case AssetDescription():
            if version < SIZED:
                raise ValueError("assets exist from bitstream 4.1 on")
            head = put_text(description.name) + TWO_LAYOUT.pack(description.type, description.id)
            bodies = _put_bodies(description.bodies, version)
            markers = [
                put_text(m.name) + ASSET_MARKER_LAYOUT.pack(m.id, *m.position, m.size, m.params)
                for m in description.markers
            ]
            count = I32.pack(len(markers))
            return DescriptionType.ASSET, b"".join((head, bodies, count, *markers))
        case _:
            if version < SIZED:
                raise ValueError("an unknown description has no size before 4.1")
            return description.type, description.data


def _put_body(body: BodyDescription, version: Version) -> bytes:
    head = BODY_HEAD_LAYOUT.pack(body.id, body.parent, *body.offset)
    rotation = b"" if body.rotation is None else QUATERNION_LAYOUT.pack(*body.rotation)
    if version < TICKED:
        return put_text(body.name) + head
    n = len(body.positions)
    if len(body.labels) != n or (version >= NAMES_FROM and len(body.markers) != n):
        raise ValueError(f"{body.name}: expected one label and one name for each marker")
    markers = [XYZ.pack(*position) for position in body.positions]
    labels = [I32.pack(label) for label in body.labels]
    names = [put_text(name) for name in body.markers] if version >= NAMES_FROM else []
    return b"".join((put_text(body.name), head, rotation, I32.pack(n), *markers, *labels, *names))


def _put_bodies(bodies: tuple[BodyDescription, ...], version: Version) -> bytes:
    return I32.pack(len(bodies)) + b"".join(_put_body(body, version) for body in bodies)
