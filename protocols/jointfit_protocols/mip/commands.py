"""MIP commands and replies that configure a device.

A command packet has one field. Its reply contains the field 0xF1, ``command | code``. Replies to
read commands also contain a field with the values. Most commands begin with a function: 1 write, 2
read, 3 save, 4 load, 5 default. Settings are volatile until they are saved.

The two families of devices use different commands for the same settings:

|           | current                       | legacy: IMU (0x80)       | legacy: filter (0x82)    |
|-----------|-------------------------------|--------------------------|--------------------------|
| base rate | 0C,0E: set -> 8E: set, U2 Hz  | 0C,06 -> 83: U2          | 0C,0B -> 8A: U2          |
| format    | 0C,0F: fn, set, n, list -> 8F | 0C,08: fn, n, list -> 80 | 0C,0A: fn, n, list -> 82 |
| stream    | 0C,11: fn, set, on -> 85      | selector 1               | selector 3               |

In the table, ``set`` is a descriptor set, ``fn`` is the function, and ``n`` is the number of
entries in the list. The command is before the arrow, and its reply is after the arrow. An entry of
the list is ``field U1 | decimation U2``. U1 and U2 are unsigned integers of 1 and 2 bytes.

Source: definitions of the vendor's mip_sdk (MIT).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Literal, NamedTuple

from jointfit_protocols.mip._framing import encode

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_protocols.mip._framing import MipPacket

Family = Literal["current", "legacy"]

REPLY = 0xF1
"""Descriptor of the field with command and code, which every reply contains."""
REPLY_BYTES = 2
"""Size of the data of the field `REPLY`, bytes."""
OK, UNKNOWN_COMMAND = 0, 1
CODES = {
    UNKNOWN_COMMAND: "unknown command",
    2: "invalid checksum",
    3: "invalid parameter",
    4: "command failed",
    5: "timeout",
}


class CommandSet(IntEnum):
    """Descriptor sets that contain commands."""

    BASE = 0x01
    SETUP = 0x0C
    FILTER = 0x0D


class Base(IntEnum):
    """Commands of the set 0x01, and the data of their replies."""

    PING = 0x01
    IDLE = 0x02
    DEVICE_INFO = 0x03
    DESCRIPTORS = 0x04
    RESUME = 0x06
    MORE_DESCRIPTORS = 0x07
    PORT_SPEED = 0x09
    DEVICE_INFO_REPLY = 0x81
    DESCRIPTORS_REPLY = 0x82
    MORE_DESCRIPTORS_REPLY = 0x86
    PORT_SPEED_REPLY = 0x89


class Setup(IntEnum):
    """Commands of the set 0x0C, and the data of their replies."""

    IMU_BASE_RATE = 0x06
    IMU_FORMAT = 0x08
    FILTER_FORMAT = 0x0A
    FILTER_BASE_RATE = 0x0B
    BASE_RATE = 0x0E
    FORMAT = 0x0F
    STREAM = 0x11
    STARTUP_SETTINGS = 0x30
    TRANSFORM = 0x32
    UART_BAUD = 0x40
    IMU_FORMAT_REPLY = 0x80
    FILTER_FORMAT_REPLY = 0x82
    IMU_BASE_RATE_REPLY = 0x83
    STREAM_REPLY = 0x85
    UART_BAUD_REPLY = 0x87
    FILTER_BASE_RATE_REPLY = 0x8A
    BASE_RATE_REPLY = 0x8E
    FORMAT_REPLY = 0x8F
    TRANSFORM_REPLY = 0xB2


class FilterSetup(IntEnum):
    """Commands of the set 0x0D, and the data of their replies."""

    ROTATION = 0x11
    """Sensor-to-vehicle rotation in the legacy family: roll, pitch, yaw, rad."""
    ROTATION_REPLY = 0x81


class Function(IntEnum):
    """First byte of a command that concerns a setting."""

    WRITE = 1
    READ = 2
    SAVE = 3
    LOAD = 4
    DEFAULT = 5


class FormatEntry(NamedTuple):
    """One entry of a message format."""

    field: int
    decimation: int
    """Base rate divided by the output rate."""


class DeviceInformation(NamedTuple):
    """Content of the reply to the command 01,03."""

    firmware: int
    """Firmware version times 1000: 1105 means 1.1.05."""
    model_name: str
    model_number: str
    serial: str
    lot: str
    options: str

    @property
    def version(self) -> str:
        """Firmware version as the vendor writes it."""
        return f"{self.firmware // 1000}.{self.firmware // 100 % 10}.{self.firmware % 100:02d}"


class StreamCommands(NamedTuple):
    """Commands of one device family for one data set; all belong to the set 0x0C."""

    base_rate: int
    base_rate_reply: int
    format: int
    format_reply: int
    prefix: bytes
    """Bytes that identify the data set in commands and replies about rate and format."""
    selector: int
    """Number of the data set in the stream command."""


def stream_commands(family: Family, descriptor_set: int) -> StreamCommands:
    """Return the commands for the data set 0x80 or 0x82; in the current family, for any set."""
    if family == "current":
        return StreamCommands(
            Setup.BASE_RATE,
            Setup.BASE_RATE_REPLY,
            Setup.FORMAT,
            Setup.FORMAT_REPLY,
            bytes((descriptor_set,)),
            descriptor_set,
        )
    return _LEGACY[descriptor_set]


_LEGACY = {
    0x80: StreamCommands(
        Setup.IMU_BASE_RATE,
        Setup.IMU_BASE_RATE_REPLY,
        Setup.IMU_FORMAT,
        Setup.IMU_FORMAT_REPLY,
        b"",
        1,
    ),
    0x82: StreamCommands(
        Setup.FILTER_BASE_RATE,
        Setup.FILTER_BASE_RATE_REPLY,
        Setup.FILTER_FORMAT,
        Setup.FILTER_FORMAT_REPLY,
        b"",
        3,
    ),
}
_INFO = struct.Struct(">H16s16s16s16s16s")
_OUTPUT = struct.Struct(">BH")
_RATE = struct.Struct(">H")
_MOST_OUTPUTS = 82
"""Largest number of entries of a message format in one packet."""


def encode_command(descriptor_set: int, command: int, data: bytes = b"") -> bytes:
    """Return the packet of one command."""
    return encode(descriptor_set, ((command, data),))


def reply_code(packet: MipPacket, command: int) -> int | None:
    """Return the code in the reply to `command`; None if the packet contains no such reply."""
    for descriptor, data in packet.fields:
        if descriptor == REPLY and len(data) == REPLY_BYTES and data[0] == command:
            return data[1]
    return None


def reply_data(packet: MipPacket, descriptor: int) -> bytes | None:
    """Return the data of a field in a reply; None if the reply does not contain the field."""
    return next((data for found, data in packet.fields if found == descriptor), None)


def code_text(code: int) -> str:
    """Return a description of a reply code."""
    return f"code {code}, {CODES.get(code, 'unknown to this version')}"


def encode_info(info: DeviceInformation) -> bytes:
    """Return the data of a reply with device information."""
    texts = (text.encode("ascii", "replace").ljust(16) for text in map(str, info[1:]))
    return _INFO.pack(info.firmware, *texts)


def decode_info(data: bytes) -> DeviceInformation | None:
    """Return the device information in `data`; None if it is malformed."""
    if len(data) != _INFO.size:
        return None
    firmware, *texts = _INFO.unpack(data)
    name, number, serial, lot, options = (
        text.decode("ascii", "replace").strip(" \0") for text in texts
    )
    return DeviceInformation(firmware, name, number, serial, lot, options)


def encode_descriptors(descriptors: Iterable[int]) -> bytes:
    """Return the data of a list of descriptors, each ``set << 8 | descriptor``."""
    return b"".join(descriptor.to_bytes(2, "big") for descriptor in descriptors)


def decode_descriptors(data: bytes) -> frozenset[int]:
    """Return the descriptors in a reply, each ``set << 8 | descriptor``."""
    return frozenset(data[at] << 8 | data[at + 1] for at in range(0, len(data) - 1, 2))


def encode_outputs(prefix: bytes, outputs: Iterable[tuple[int, int]]) -> bytes:
    """Return the list of a message format for a reply, or for a command after its function."""
    entries = [_OUTPUT.pack(*output) for output in outputs]
    return prefix + bytes((len(entries),)) + b"".join(entries)


def decode_outputs(prefix: bytes, data: bytes) -> tuple[FormatEntry, ...] | None:
    """Return the entries of a message format; None if `data` do not belong to this data set."""
    head = len(prefix)
    if not data.startswith(prefix) or len(data) <= head:
        return None
    count = data[head]
    if count > _MOST_OUTPUTS or len(data) != head + 1 + count * _OUTPUT.size:
        return None
    return tuple(FormatEntry(*entry) for entry in _OUTPUT.iter_unpack(data[head + 1 :]))


def encode_rate(prefix: bytes, rate_hz: int) -> bytes:
    """Return the data of a reply with a base rate."""
    return prefix + _RATE.pack(rate_hz)


def decode_rate(prefix: bytes, data: bytes) -> int | None:
    """Return a base rate, Hz; None if `data` do not belong to this data set."""
    if not data.startswith(prefix) or len(data) != len(prefix) + _RATE.size:
        return None
    return int.from_bytes(data[-_RATE.size :], "big")


def encode_floats(*values: float) -> bytes:
    """Return the data of a command or reply with a transform."""
    return struct.pack(f">{len(values)}f", *values)


def decode_floats(data: bytes, count: int) -> tuple[float, ...] | None:
    """Return the values of a transform: 4 for a quaternion, 3 for angles; None for other sizes."""
    return struct.unpack(f">{count}f", data) if len(data) == 4 * count else None
