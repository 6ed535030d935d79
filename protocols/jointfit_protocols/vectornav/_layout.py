"""Layout of a VectorNav binary output, which its header describes.

    | groups U1 | fields of group 1, U2 | fields of group 2, U2 | ... | payload |

Bit k of ``groups`` announces group k + 1, bit k of the fields of a group announces its field k.
The payload contains the announced fields in ascending order, little-endian, without padding.
Firmware from 2023 on announces further groups by bit 7 of ``groups`` and further fields by bit 15.
This module has no layout for a header with either bit, or with a field of unknown size.

Source: VN-100 user manual (UM001), section 5, "binary output messages"; field sizes compared with
the vendor's programming library (MIT).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Fields = tuple[int, ...]
"""Fields of an output, each ``group << 4 | bit``, group from 0, in ascending order."""
_GROUP_BITS = 4
_UNKNOWN = 0x80
"""Bit of ``groups`` that announces a second byte of groups."""


class Field(IntEnum):
    """Fields that are decoded, each ``group << 4 | bit``."""

    TIME_STARTUP = 0x00
    """Time since power-up, ns."""
    YAW_PITCH_ROLL = 0x03
    """Yaw, pitch and roll, degrees."""
    QUATERNION = 0x04
    """Quaternion x, y, z, w with the scalar last, from sensor to north-east-down."""
    ANGULAR_RATE = 0x05
    """Compensated angular rate, rad/s."""
    ACCELERATION = 0x08
    """Compensated specific force, m/s^2."""
    MAGNETIC_AND_PRESSURE = 0x0A
    """Compensated field, gauss, three values; temperature, C; pressure, kPa."""
    TIME_GROUP_STARTUP = 0x10
    IMU_MAGNETIC_FIELD = 0x28
    IMU_ACCELERATION = 0x29
    IMU_ANGULAR_RATE = 0x2A
    ATTITUDE_STATUS = 0x40
    """Bits 0 and 1: quality of the attitude, 0 excellent to 3 not tracking."""
    ATTITUDE_QUATERNION = 0x42


_GNSS = ("8s", "Q", "H", "B", "B", "3d", "3d", "3f", "3f", "3f", "f", "I", "2s", "28s")
_FORMATS: tuple[tuple[str, ...], ...] = (
    ("Q", "Q", "Q", "3f", "4f", "3f", "3d", "3f", "3f", "6f", "5f", "7f", "H", "I", "Q"),
    ("Q", "Q", "Q", "H", "Q", "Q", "8s", "I", "I", "B"),
    ("H", "3f", "3f", "3f", "f", "f", "4f", "3f", "3f", "3f", "3f", "2s",
     "40s"),
    _GNSS,
    ("H", "3f", "4f", "9f", "3f", "3f", "3f", "3f", "3f", "12s", "28s", "24s"),
    ("H", "3d", "3d", "3f", "3f", "3f", "3f", "3f", "3f", "f", "f", "68s", "64s"),
    _GNSS,
)  # fmt: skip
"""Struct codes of the fields of each group: common, time, IMU, GNSS, attitude, INS, GNSS 2."""
GROUPS = len(_FORMATS)
MAX_PAYLOAD = sum(struct.calcsize("<" + code) for group in _FORMATS for code in group)
"""Size of a payload with all fields, bytes."""


class BinaryLayout:
    """Places of the fields in the payload of one kind of output.

    Parameters
    ----------
    fields : iterable of int
        Fields of the header, in any order.

    Raises
    ------
    KeyError
        The size of a field is unknown.
    """

    __slots__ = ("fields", "header", "places", "struct")

    def __init__(self, fields: Iterable[int]) -> None:
        self.fields: Fields = tuple(sorted(set(fields)))
        masks: dict[int, int] = {}
        written, at = "<", 0
        self.places: dict[int, slice] = {}
        """Place of each field among the values of the payload."""

        for field in self.fields:
            group, bit = divmod(field, 1 << _GROUP_BITS)
            if group >= GROUPS or bit >= len(_FORMATS[group]):
                raise KeyError(f"field {bit} of group {group + 1} has no known size")
            code = _FORMATS[group][bit]
            count = 1 if code.endswith("s") or len(code) == 1 else int(code[:-1])
            masks[group] = masks.get(group, 0) | 1 << bit
            self.places[field] = slice(at, at + count)
            written += code
            at += count

        self.struct = struct.Struct(written)
        self.header = header_of(masks)
        """Number of bytes from ``groups`` to the payload."""


def header_of(masks: Mapping[int, int]) -> bytes:
    """Return the header of an output whose groups, from 0, have these fields."""
    groups = sum(1 << group for group in masks)
    words = (masks[group].to_bytes(2, "little") for group in sorted(masks))
    return bytes((groups,)) + b"".join(words)


def header_bytes(groups: int) -> int | None:
    """Return the size of a header by its first byte; None if no supported header has this byte."""
    return None if groups == 0 or groups & _UNKNOWN else 1 + 2 * groups.bit_count()


@lru_cache(maxsize=64)
def layout_of(header: bytes) -> BinaryLayout | None:
    """Return the layout that a header of the right size describes; None if it is unknown."""
    groups = [group for group in range(GROUPS) if header[0] >> group & 1]
    fields: list[int] = []
    for number, group in enumerate(groups):
        mask = int.from_bytes(header[1 + 2 * number : 3 + 2 * number], "little")
        if mask >> len(_FORMATS[group]):
            return None
        fields += (group << _GROUP_BITS | bit for bit in range(16) if mask >> bit & 1)
    return BinaryLayout(fields) if fields else None
