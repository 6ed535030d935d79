"""Layout of a VectorNav binary output, which its header describes.

    | groups U1 | fields of group 1, U2 | fields of group 2, U2 | ... | payload |

U1 and U2 are unsigned integers of 1 and 2 bytes. Bit k of ``groups`` announces the group k + 1. Bit
k in the fields of a group announces the field k of this group. The payload contains the announced
fields in ascending order, little-endian and without padding. Firmware since 2023 extends groups and
fields. If bit 7 of the byte of groups is set, a second byte announces the groups from 9 on. If bit
15 of a word of fields is set, a second word announces the fields from 16 on. This module has no
layout for a header with a field of unknown or variable size.

Sources: VN-100 user manual (UM001), section 5, "binary output messages". The sizes of fields and
the extensions are from the vendor's programming libraries (MIT; SDK 0.99).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Fields = tuple[int, ...]
"""Fields of an output in ascending order, each ``group << 8 | bit`` with groups counted from 0."""
_GROUP_BITS = 8
_MORE_GROUPS = 0x80
"""Bit in a byte of groups that announces a second byte of groups."""
_MORE_FIELDS = 0x8000
"""Bit in a word of fields that announces a second word of fields."""


class Field(IntEnum):
    """Fields that can be decoded, each ``group << 8 | bit``."""

    TIME_STARTUP = 0x00
    """Time since power-up, ns."""
    YAW_PITCH_ROLL = 0x03
    """Yaw, pitch and roll, degrees."""
    QUATERNION = 0x04
    """Quaternion x, y, z, w with the scalar last, from sensor to a north-east-down world."""
    ANGULAR_RATE = 0x05
    """Compensated angular rate, rad/s."""
    ACCELERATION = 0x08
    """Compensated specific force, m/s^2."""
    MAGNETIC_AND_PRESSURE = 0x0A
    """Compensated magnetic field, gauss, three values; temperature, °C; pressure, kPa."""
    TIME_GROUP_STARTUP = 0x100
    IMU_MAGNETIC_FIELD = 0x208
    IMU_ACCELERATION = 0x209
    IMU_ANGULAR_RATE = 0x20A
    ATTITUDE_STATUS = 0x400
    """Bits 0 and 1: quality of the attitude, from 0 (excellent) to 3 (not tracking)."""
    ATTITUDE_QUATERNION = 0x402


_COMMON = ("Q", "Q", "Q", "3f", "4f", "3f", "3d", "3f", "3f", "6f", "5f", "7f", "H", "I", "Q")
_TIME = ("Q", "Q", "Q", "H", "Q", "Q", "8s", "I", "I", "B")
_IMU = ("H", "3f", "3f", "3f", "f", "f", "4f", "3f", "3f", "3f", "3f", "2s", "40s")
_GNSS = ("8s", "Q", "H", "B", "B", "3d", "3d", "3f", "3f", "3f", "f", "I", "2s", "28s")
_ATTITUDE = ("H", "3f", "4f", "9f", "3f", "3f", "3f", "3f", "3f", "12s", "28s", "24s", "3f", "f")
_INS = ("H", "3d", "3d", "3f", "3f", "3f", "3f", "3f", "3f", "f", "f", "68s", "64s")
_MORE_GNSS = {17: "2s", 18: "8s"}
"""Struct codes of the fields status (17) and altitude (18). The fields satellites (14) and raw
measurements (16) have variable sizes."""
_FORMATS: dict[int, dict[int, str]] = {
    0: dict(enumerate(_COMMON)),
    1: dict(enumerate(_TIME)),
    2: dict(enumerate(_IMU)),
    3: dict(enumerate(_GNSS)) | _MORE_GNSS,
    4: dict(enumerate(_ATTITUDE)),
    5: dict(enumerate(_INS)),
    6: dict(enumerate(_GNSS)) | _MORE_GNSS,
    12: dict(enumerate(_GNSS)) | _MORE_GNSS,
}
"""Struct codes of the fields of each group: common, time, IMU, GNSS, attitude, INS, GNSS 2 and 3.
"""
MAX_PAYLOAD = sum(struct.calcsize("<" + x) for group in _FORMATS.values() for x in group.values())
"""Size of a payload that contains all fields, bytes."""
MAX_HEADER = 2 + 2 * (len(_FORMATS) + sum(max(group) > 15 for group in _FORMATS.values()))  # noqa: PLR2004 - bits of a word
"""Size of the header of an output that contains all fields, bytes."""


class BinaryLayout:
    """Indices of the fields in the payload of one type of output.

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
        """Index of each field among the values of the payload."""

        for field in self.fields:
            group, bit = divmod(field, 1 << _GROUP_BITS)
            code = _FORMATS.get(group, {}).get(bit)
            if code is None:
                raise KeyError(f"field {bit} of group {group + 1} has no known size")
            count = 1 if code.endswith("s") or len(code) == 1 else int(code[:-1])
            masks[group] = masks.get(group, 0) | 1 << bit
            self.places[field] = slice(at, at + count)
            written += code
            at += count

        self.struct = struct.Struct(written)
        self.header = header_of(masks)
        """Bytes from ``groups`` to the start of the payload."""


def header_of(masks: Mapping[int, int]) -> bytes:
    """Return the header of an output with these groups, counted from 0, and their fields."""
    groups = sum(1 << group for group in masks)
    more = groups >> 8
    header = bytes((groups & 0x7F | _MORE_GROUPS, more) if more else (groups,))
    for group in sorted(masks):
        low, high = masks[group] & 0xFFFF, masks[group] >> 16
        words = (low | _MORE_FIELDS, high) if high else (low,)
        header += b"".join(word.to_bytes(2, "little") for word in words)
    return header


def header_bytes(buffer: bytes, at: int) -> int | None:
    """Return the size of the header at `at`; 0 for an unknown layout, None if it is cut off."""
    end = len(buffer)
    if at >= end:
        return None
    groups, size = buffer[at], 1
    if groups & _MORE_GROUPS:
        if at + 1 >= end:
            return None
        groups, size = groups & 0x7F | buffer[at + 1] << 8, 2
    if not groups or groups & ~_KNOWN_GROUPS:
        return 0

    for _ in range(groups.bit_count()):
        size += 2
        if at + size > end:
            return None
        size += 2 * (buffer[at + size - 1] >> 7)  # the high byte of the word: bit 15
    return size if at + size <= end else None


_KNOWN_GROUPS = sum(1 << group for group in _FORMATS)


@lru_cache(maxsize=64)
def layout_of(header: bytes) -> BinaryLayout | None:
    """Return the layout that a complete header describes; None if it is unknown."""
    groups, at = header[0] & 0x7F, 1
    if header[0] & _MORE_GROUPS:
        groups, at = groups | header[1] << 8, 2
    fields: list[int] = []
    for group in range(groups.bit_length()):
        if not groups >> group & 1:
            continue
        mask = int.from_bytes(header[at : at + 2], "little")
        at += 2
        if mask & _MORE_FIELDS:
            mask = mask & ~_MORE_FIELDS | int.from_bytes(header[at : at + 2], "little") << 16
            at += 2
        bits = [bit for bit in range(mask.bit_length()) if mask >> bit & 1]
        if not _FORMATS[group].keys() >= set(bits):
            return None
        fields += (group << _GROUP_BITS | bit for bit in bits)
    return BinaryLayout(fields) if fields else None
