"""Items of an MTData2 message, with counts and floats as sent and without conversion of units.

    | DataID U2 | size U1 | size bytes |   repeated; the last item ends exactly with the message

U1, U2 and U4 are unsigned integers of 1, 2 and 4 bytes, and I2 is a signed integer of 2 bytes. The
low four bits of the DataID of a real-valued item define its encoding and its world:

| bits 1:0 | encoding                                  | bytes |   | bits 3:2 | world |
|----------|-------------------------------------------|-------|   |----------|-------|
| 0        | float32                                   | 4     |   | 0x0      | ENU   |
| 1        | int32 / 2^20                              | 4     |   | 0x4      | NED   |
| 2        | 48 bit / 2^32: fraction U4, whole part I2 | 6     |   | 0x8      | NWU   |
| 3        | float64                                   | 8     |

Source: MT0101P rev. 2020.A, section MTData2; checked on recorded devices.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_protocols.orientation import World

Reals = tuple[float, ...]


class Item(IntEnum):
    """Data identifiers. Precision and world bits, if any, are zero."""

    UTC_TIME = 0x1010
    PACKET_COUNTER = 0x1020
    """U2 counter, modulo 65536, which every MTData2 message increments."""
    SAMPLE_TIME_FINE = 0x1060
    """Time of the sample, U4, in ticks of 100 us."""
    SAMPLE_TIME_COARSE = 0x1070
    """Time of the sample, U4, s."""
    QUATERNION = 0x2010
    """Quaternion w x y z from sensor to world."""
    ROTATION_MATRIX = 0x2020
    """Rotation matrix R(q), column by column."""
    EULER_ANGLES = 0x2030
    """Roll, pitch, yaw, deg."""
    DELTA_V = 0x4010
    """Increment of velocity in the sample interval, m/s."""
    ACCELERATION = 0x4020
    """Specific force, m/s^2."""
    FREE_ACCELERATION = 0x4030
    """Acceleration without gravity, world coordinates, m/s^2."""
    TRIGGER_IN1 = 0x4810
    """An edge on a sync input. It is sent only in the next message after the edge."""
    TRIGGER_IN2 = 0x4820
    GNSS_PVT = 0x7010
    """Position, velocity and time of a GNSS receiver: 94 bytes, not decoded."""
    RATE_OF_TURN = 0x8020
    """Angular rate, rad/s."""
    DELTA_Q = 0x8030
    """Increment of orientation in the sample interval, as a quaternion w x y z."""
    MAGNETIC_FIELD = 0xC020
    """Magnetic field relative to the field at calibration, without unit."""
    STATUS_BYTE = 0xE010
    STATUS_WORD = 0xE020


KNOWN_ITEMS = frozenset((
    0x0810, 0x1010, 0x1020, 0x1030, 0x1040, 0x1050, 0x1060, 0x1070, 0x2010, 0x2020, 0x2030, 0x3010,
    0x4010, 0x4020, 0x4030, 0x4040, 0x4810, 0x4820, 0x5020, 0x5030, 0x5040, 0x7010, 0x7020, 0x7030,
    0x8020, 0x8030, 0x8040, 0x8830, 0x8840, 0x8880, 0x88A0, 0xA010, 0xA020, 0xB010, 0xB020, 0xC020,
    0xD010, 0xE010, 0xE020, 0xE040, 0xE080, 0xE090,
))  # fmt: skip
"""Documented data identifiers, with precision and world bits set to zero. Most are not decoded."""


class Precision(IntEnum):
    """Encoding of a real-valued item, in bits 1:0 of its identifier."""

    FLOAT32 = 0
    FIXED_12_20 = 1
    FIXED_16_32 = 2
    FLOAT64 = 3


class UtcTime(NamedTuple):
    """Content of the item 0x1010."""

    nanosecond: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    flags: int
    """Validity flags: 1 time of week valid, 2 week valid, 4 UTC valid."""


class Trigger(NamedTuple):
    """Content of the items 0x4810 and 0x4820: an edge on a sync input."""

    line: int
    polarity: int
    time: int
    """Time of the edge in ticks of SampleTimeFine."""
    frame: int
    """Number of the edge, according to the documentation."""


Value = int | Reals | UtcTime | Trigger | bytes

FILTER_VALID = 1 << 1
CLIPPING = 1 << 19

_WORLDS: dict[int, World] = {0x0: "ENU", 0x4: "NED", 0x8: "NWU"}
_WORLD_BITS: dict[World, int] = {world: bits for bits, world in _WORLDS.items()}
_REALS: dict[int, int] = {
    Item.QUATERNION: 4,
    Item.ROTATION_MATRIX: 9,
    Item.EULER_ANGLES: 3,
    Item.DELTA_V: 3,
    Item.ACCELERATION: 3,
    Item.FREE_ACCELERATION: 3,
    Item.RATE_OF_TURN: 3,
    Item.DELTA_Q: 4,
    Item.MAGNETIC_FIELD: 3,
}
COUNT_BYTES: dict[int, int] = {
    Item.PACKET_COUNTER: 2,
    Item.SAMPLE_TIME_FINE: 4,
    Item.SAMPLE_TIME_COARSE: 4,
    Item.STATUS_BYTE: 1,
    Item.STATUS_WORD: 4,
}
"""Length of the unsigned integer in an item, bytes."""
_BYTES = (4, 4, 6, 8)
"""Length of one real number for each precision, bytes."""
_UTC = struct.Struct(">IHBBBBBB")
_TRIGGER = struct.Struct(">BBIH")
_TRIGGERS = {int(Item.TRIGGER_IN1), int(Item.TRIGGER_IN2)}
_GNSS_PVT_BYTES = 94
_ITEM_HEAD = 3
_FLOATS = tuple(struct.Struct(f">{count}f") for count in range(10))


def world_of(data_id: int) -> World | None:
    """Return the world of an item; None for a reserved bit pattern."""
    return _WORLDS.get(data_id & 0xC)


def real_id(item: Item, precision: Precision = Precision.FLOAT32, world: World = "ENU") -> int:
    """Return the DataID of a real-valued item with this precision and world."""
    return item | _WORLD_BITS[world] | precision


def split(data: bytes) -> list[tuple[int, bytes]] | None:
    """Return DataID and bytes of every item; None if the items do not fill the message exactly."""
    items: list[tuple[int, bytes]] = []
    at, end = 0, len(data)
    while at + _ITEM_HEAD <= end:
        after = at + _ITEM_HEAD + data[at + 2]
        items.append((data[at] << 8 | data[at + 1], data[at + _ITEM_HEAD : after]))
        at = after
    return items if at == end else None


def decode_reals(data_id: int, raw: bytes, count: int) -> Reals | None:
    """Return `count` reals in the precision of `data_id`; None if the size is wrong."""
    precision = data_id & 0x3
    if len(raw) != count * _BYTES[precision]:
        return None
    if precision == Precision.FLOAT32:
        return _FLOATS[count].unpack(raw)  # every sample takes this path

    if precision == Precision.FLOAT64:
        return struct.unpack(f">{count}d", raw)
    if precision == Precision.FIXED_12_20:
        return tuple(value / 2**20 for value in struct.unpack(f">{count}i", raw))

    halves = struct.unpack(">" + count * "Ih", raw)
    return tuple(
        whole + fraction / 2**32 for fraction, whole in zip(halves[::2], halves[1::2], strict=True)
    )


def decode_item(data_id: int, raw: bytes) -> Value | None:
    """Return the value of one item; None if the item is unknown or its size is wrong."""
    if data_id in COUNT_BYTES:
        return int.from_bytes(raw, "big") if len(raw) == COUNT_BYTES[data_id] else None
    if data_id == Item.UTC_TIME:
        return UtcTime(*_UTC.unpack(raw)) if len(raw) == _UTC.size else None
    if data_id in _TRIGGERS:
        return Trigger(*_TRIGGER.unpack(raw)) if len(raw) == _TRIGGER.size else None
    if data_id == Item.GNSS_PVT:
        return raw if len(raw) == _GNSS_PVT_BYTES else None

    count = _REALS.get(data_id & 0xFFF0)
    if count is None or world_of(data_id) is None:
        return None
    return decode_reals(data_id, raw, count)


def encode_reals(data_id: int, values: Iterable[float]) -> bytes:
    """Return reals encoded in the precision of `data_id`; fixed-point values are rounded.

    Raises
    ------
    struct.error, OverflowError
        A value does not fit the encoding.
    """
    values = tuple(values)
    precision = data_id & 0x3
    if precision == Precision.FLOAT32:
        return struct.pack(f">{len(values)}f", *values)
    if precision == Precision.FLOAT64:
        return struct.pack(f">{len(values)}d", *values)
    if precision == Precision.FIXED_12_20:
        return struct.pack(f">{len(values)}i", *(round(value * 2**20) for value in values))
    fixed = (round(value * 2**32) for value in values)
    return b"".join(struct.pack(">Ih", value & 0xFFFFFFFF, value >> 32) for value in fixed)


def encode_item(data_id: int, value: Value) -> bytes:
    """Return one encoded item, including its head.

    Raises
    ------
    KeyError
        The value is an integer, but the item is not.
    struct.error, OverflowError
        A value does not fit the encoding.
    """
    if isinstance(value, bytes):
        raw = value
    elif isinstance(value, UtcTime):
        raw = _UTC.pack(*value)
    elif isinstance(value, Trigger):
        raw = _TRIGGER.pack(*value)
    elif isinstance(value, int):
        raw = value.to_bytes(COUNT_BYTES[data_id], "big")
    else:
        raw = encode_reals(data_id, value)
    return struct.pack(">HB", data_id, len(raw)) + raw


def encode_items(items: Iterable[tuple[int, Value]]) -> bytes:
    """Return the data of one MTData2 message that contains these items."""
    return b"".join(encode_item(data_id, value) for data_id, value in items)


def reals_in(data_id: int) -> int | None:
    """Return the number of real values in an item; None if it contains none."""
    return _REALS.get(data_id & 0xFFF0) if world_of(data_id) else None
