"""MTData, the measurement message of older devices: MTi and MTx of the first generations.

An MTData message has no item heads. The output mode and the output settings of the device define
which fields a message contains. The fields have this order: raw inertial, raw GNSS, temperature,
calibrated data, orientation, auxiliary inputs, position, velocity, status, sample counter, UTC
time. A message is rejected if its length does not match the mode.

| output settings | meaning                                                        |
|-----------------|----------------------------------------------------------------|
| 0x00000001      | sample counter, U2, wraps                                      |
| 0x00000002      | UTC time, 12 bytes                                             |
| 0x0000000C      | orientation: 0 quaternion, 4 Euler angles, 8 matrix            |
| 0x00000070      | omits accelerometer (1), gyroscope (2), magnetometer (4)       |
| 0x00000300      | reals: 0 float32, 1 fixed 12.20, 2 fixed 16.32, 3 float64      |
| 0x00000C00      | omits the auxiliary inputs                                     |
| 0x80000000      | the world is NED                                               |

U2 is an unsigned integer of 2 bytes. "Fixed 12.20" is a fixed-point number with 12 bits before and
20 bits after the point.

Source: legacy part of the MT low-level protocol. Fields and their order agree with the open driver
ethzasl_xsens_driver, which supports only float32. No recording was available. The sources differ on
the world without the NED flag. In the manuals of MTi and MTx, x points to magnetic north, y west
and z up. In ethzasl_xsens_driver, x points east.
"""

from __future__ import annotations

import struct
from enum import IntFlag
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.xbus.mtdata2 import (
    Item,
    Precision,
    decode_reals,
    encode_reals,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_protocols.xbus.mtdata2 import Value

PERIOD_HZ = 115_200
"""Unit of the sample period: 1/115200 s."""
COUNTS = 1 << 16
"""Modulus of the sample counter."""


class OutputMode(IntFlag):
    """Fields that a message contains."""

    TEMPERATURE = 0x0001
    CALIBRATED = 0x0002
    ORIENTATION = 0x0004
    AUXILIARY = 0x0008
    POSITION = 0x0010
    VELOCITY = 0x0020
    STATUS = 0x0800
    RAW_GNSS = 0x1000
    RAW_INERTIAL = 0x4000


SAMPLE_COUNTER, UTC_TIME = 0x1, 0x2
EULER, MATRIX = 0x4, 0x8
NO_ACCELERATION, NO_RATE, NO_MAGNETIC = 0x10, 0x20, 0x40
FORMAT_SHIFT = 8
NO_INPUT_1, NO_INPUT_2 = 0x400, 0x800
NED = 0x8000_0000
_CONFIGURATION = struct.Struct(">96xH6xHI8x")
"""Layout of a Configuration message: number of devices, and output mode and output settings of the
first device."""
_ORIENTATION_MASK, _FORMAT_MASK = 0xC, 0x3
_KNOWN_MODES = sum(OutputMode)
_RAW_BYTES, _GNSS_BYTES, _UTC_BYTES, _INPUT_BYTES = 20, 44, 12, 2
_REAL_BYTES = dict(zip(Precision, (4, 4, 6, 8), strict=True))


class LegacyField(NamedTuple):
    """Position of one decoded field in the message."""

    item: int
    """MTData2 identifier of the same quantity."""
    start: int
    size: int
    reals: int
    """Number of real values; 0 for an unsigned integer."""


class MTDataLayout:
    """Fields in the messages of one device.

    Parameters
    ----------
    mode : int
        Output mode; see `OutputMode`.
    settings : int
        Output settings, as in the table of this module.

    Raises
    ------
    ValueError
        The mode is unknown.
    """

    def __init__(self, mode: int, settings: int) -> None:
        precision = settings >> FORMAT_SHIFT & _FORMAT_MASK
        if mode & ~_KNOWN_MODES:
            raise ValueError(f"output mode 0x{mode:04X} with settings 0x{settings:08X} is unknown")
        self.mode, self.settings = mode, settings
        self.precision = Precision(precision)
        self.fields: list[LegacyField] = []
        self.size = 0
        """Length of the data in a message, bytes."""

        self._skip(_RAW_BYTES, mode & OutputMode.RAW_INERTIAL)
        self._skip(_GNSS_BYTES, mode & OutputMode.RAW_GNSS)
        self._skip(_REAL_BYTES[self.precision], mode & OutputMode.TEMPERATURE)
        if mode & OutputMode.CALIBRATED:
            self._reals(Item.ACCELERATION, 3, not settings & NO_ACCELERATION)
            self._reals(Item.RATE_OF_TURN, 3, not settings & NO_RATE)
            self._reals(Item.MAGNETIC_FIELD, 3, not settings & NO_MAGNETIC)
        kind = settings & _ORIENTATION_MASK
        oriented = bool(mode & OutputMode.ORIENTATION)
        self._reals(Item.QUATERNION, 4, oriented and not kind)
        self._reals(Item.EULER_ANGLES, 3, oriented and kind == EULER)
        self._reals(Item.ROTATION_MATRIX, 9, oriented and kind == MATRIX)
        if mode & OutputMode.AUXILIARY:
            self._skip(_INPUT_BYTES, not settings & NO_INPUT_1)
            self._skip(_INPUT_BYTES, not settings & NO_INPUT_2)
        self._skip(3 * _REAL_BYTES[self.precision], mode & OutputMode.POSITION)
        self._skip(3 * _REAL_BYTES[self.precision], mode & OutputMode.VELOCITY)
        self._count(Item.STATUS_BYTE, 1, mode & OutputMode.STATUS)
        self._count(Item.PACKET_COUNTER, 2, settings & SAMPLE_COUNTER)
        self._skip(_UTC_BYTES, settings & UTC_TIME)

    def _skip(self, size: int, present: int) -> None:
        self.size += size if present else 0

    def _reals(self, item: int, count: int, present: bool) -> None:
        if present:
            size = count * _REAL_BYTES[self.precision]
            self.fields.append(LegacyField(item, self.size, size, count))
            self.size += size

    def _count(self, item: int, size: int, present: int) -> None:
        if present:
            self.fields.append(LegacyField(item, self.size, size, 0))
            self.size += size

    @property
    def items(self) -> set[int]:
        """Identifiers of the fields that can be decoded."""
        return {field.item for field in self.fields}

    def read(self, data: bytes) -> dict[int, Value] | None:
        """Return the values by identifier; None if the length does not match the output mode."""
        if len(data) != self.size:
            return None
        values: dict[int, Value] = {}
        for item, start, size, count in self.fields:
            raw = data[start : start + size]
            if count:
                reals = decode_reals(self.precision, raw, count)
                if reals is not None:
                    values[item] = reals
            else:
                values[item] = int.from_bytes(raw, "big")
        return values

    def write(self, values: Mapping[int, Value]) -> bytes:
        """Return the data of a message. Fields without a value are zeros.

        Raises
        ------
        struct.error, OverflowError
            A value does not fit the format.
        """
        data = bytearray(self.size)
        for item, start, size, count in self.fields:
            value = values.get(item)
            if value is None:
                continue
            if count and isinstance(value, tuple):
                data[start : start + size] = encode_reals(self.precision, value)
            elif isinstance(value, int):
                data[start : start + size] = value.to_bytes(size, "big")
        return bytes(data)


def decode_output_mode(data: bytes) -> int | None:
    """Return the output mode in a reply; None if the reply is malformed."""
    return int.from_bytes(data, "big") if len(data) == 2 else None  # noqa: PLR2004 - U2


def decode_output_settings(data: bytes) -> int | None:
    """Return the output settings in a reply; None if the reply is malformed."""
    return int.from_bytes(data, "big") if len(data) == 4 else None  # noqa: PLR2004 - U4


def decode_device_configuration(data: bytes) -> tuple[int, int] | None:
    """Return output mode and settings in a Configuration; None unless it describes one device."""
    if len(data) != _CONFIGURATION.size:
        return None
    devices, mode, settings = _CONFIGURATION.unpack(data)
    return (mode, settings) if devices == 1 else None


def rate_hz(period: bytes, skip: bytes) -> float | None:
    """Return the rate of the messages, Hz; None if a reply is malformed.

    Parameters
    ----------
    period : bytes
        Reply with the sample period: U2, in units of 1/115200 s.
    skip : bytes
        Reply with the output skip factor: U2, number of samples omitted after each sent sample. It
        is empty if the device has no such setting.
    """
    if len(period) != 2 or not any(period) or len(skip) not in {0, 2}:  # noqa: PLR2004 - U2
        return None
    ticks: int = struct.unpack(">H", period)[0]
    return PERIOD_HZ / ticks / (1 + int.from_bytes(skip, "big"))
