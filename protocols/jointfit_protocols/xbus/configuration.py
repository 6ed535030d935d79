"""Payloads of the Xbus messages that configure a device.

    OutputConfiguration   N x | DataID U2 | rate U2 |                                   N <= 32
    SyncSettings          N x | function | line | polarity | once | skipFirst U2 | skipFactor U2
                              | pulseWidth U2, 100 us | delay U2, 100 us, or period, ms |   N <= 10
    AlignmentRotation         | frame U1: 0 sensor, 1 local | w x y z float32 |
    FirmwareRev               | major | minor | revision | build U4 | scm U4 |
    CanOutputConfig       N x | data id, 7 bit | 29 bit flag | identifier U4 | rate U2 |    N <= 16

Source: MT0101P rev. 2020.A; CAN from the MTi-600 pages of the same vendor.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_RATE = 0xFFFF
"""Request for the highest possible rate. Time and status items always report it."""
TICK_NS = 100_000
"""One tick of SampleTimeFine, ns."""
WRAP_32_BIT = 1 << 32
"""Ticks after which SampleTimeFine of most models wraps."""
WRAP_DAY = 864_000_000
"""Ticks after which SampleTimeFine of the MTi-10 and MTi-100 series wraps, at midnight."""
CAN_ENABLED = 1 << 8

ERRORS = {
    0x03: "period out of range",
    0x04: "message invalid",
    0x1E: "output buffer overflow: the rate is too high for the baud rate",
    0x20: "baud rate out of range",
    0x21: "parameter invalid or out of range",
    0x28: "device error",
}
_BAUD_OF_CODE = {
    0x0B: 4_800,
    0x09: 9_600,
    0x07: 19_200,
    0x05: 38_400,
    0x04: 57_600,
    0x02: 115_200,
    0x01: 230_400,
    0x00: 460_800,
    0x0A: 921_600,
    0x80: 921_600,
    0x0C: 2_000_000,
    0x0E: 3_686_400,
    0x0D: 4_000_000,
}
_CODE_OF_BAUD = {baud: code for code, baud in reversed(_BAUD_OF_CODE.items())}
BAUD_RATES = tuple(sorted(_CODE_OF_BAUD))
_DAY_WRAP_MODELS = {10, 20, 30, 100, 200, 300, 700, 710}
"""Models of the MTi-10 and MTi-100 series."""
_OUTPUT = struct.Struct(">HH")
_SYNC = struct.Struct(">BBBBHHHH")
_FIRMWARE = struct.Struct(">BBBII")
_CAN_OUTPUT = struct.Struct(">BBIH")
_ROTATION = struct.Struct(">B4f")
_FILTER_CODE_BYTES = 2


class Output(NamedTuple):
    """One entry of an output configuration."""

    data_id: int
    rate: int
    """Hz; 0 or 0xFFFF is the highest possible rate."""


class SyncSetting(NamedTuple):
    """One entry of the synchronisation settings; a list that is sent replaces the old one."""

    function: int
    """3 trigger indication, 4 SyncOut, 8 send latest, 9 clock bias, 11 start sampling, 14 1PPS."""
    line: int
    polarity: int
    """1 rising, 2 falling, 3 both, 0 off."""
    once: int = 0
    skip_first: int = 0
    skip_factor: int = 0
    pulse_width: int = 0
    """100 us, outputs only."""
    delay: int = 0
    """100 us; for clock bias estimation the reference period, ms."""


class Firmware(NamedTuple):
    """Firmware revision."""

    major: int
    minor: int
    revision: int
    build: int
    scm: int


class AlignmentRotation(NamedTuple):
    """A rotation that the device applies to its output."""

    frame: int
    """0 sensor, 1 local (world)."""
    q: tuple[float, float, float, float]


class CanOutput(NamedTuple):
    """One entry of the CAN output configuration."""

    data_id: int
    extended: bool
    identifier: int
    rate: int
    """Hz; 0x7FF is the highest possible rate."""


def encode_outputs(outputs: Iterable[tuple[int, int]]) -> bytes:
    """Return the data of SetOutputConfiguration."""
    return b"".join(_OUTPUT.pack(*output) for output in outputs)


def decode_outputs(data: bytes) -> tuple[Output, ...] | None:
    """Return the entries of an output configuration; None if they do not fill `data`."""
    if len(data) % _OUTPUT.size:
        return None
    return tuple(Output(*entry) for entry in _OUTPUT.iter_unpack(data))


def encode_sync(settings: Iterable[SyncSetting]) -> bytes:
    """Return the data of SetSyncSettings."""
    return b"".join(_SYNC.pack(*setting) for setting in settings)


def decode_sync(data: bytes) -> tuple[SyncSetting, ...] | None:
    """Return the entries of the synchronisation settings; None if they do not fill `data`."""
    if len(data) % _SYNC.size:
        return None
    return tuple(SyncSetting(*entry) for entry in _SYNC.iter_unpack(data))


def encode_can_config(code: int, *, enabled: bool) -> bytes:
    """Return the data of SetCanConfig with a bit rate code."""
    return (code | (CAN_ENABLED if enabled else 0)).to_bytes(4, "big")


def encode_can_outputs(outputs: Iterable[CanOutput]) -> bytes:
    """Return the data of SetCanOutputConfig."""
    return b"".join(_CAN_OUTPUT.pack(*output) for output in outputs)


def decode_can_outputs(data: bytes) -> tuple[CanOutput, ...] | None:
    """Return the entries of a CAN output configuration; None if they do not fill `data`."""
    if len(data) % _CAN_OUTPUT.size:
        return None
    return tuple(
        CanOutput(data_id & 0x7F, bool(flags & 1), identifier & 0x1FFFFFFF, rate & 0x7FF)
        for data_id, flags, identifier, rate in _CAN_OUTPUT.iter_unpack(data)
    )


def encode_alignment(rotation: AlignmentRotation) -> bytes:
    """Return the data of an alignment rotation."""
    return _ROTATION.pack(rotation.frame, *rotation.q)


def decode_alignment(data: bytes) -> AlignmentRotation | None:
    """Return an alignment rotation; None if `data` is not one."""
    if len(data) != _ROTATION.size:
        return None
    frame, w, x, y, z = _ROTATION.unpack(data)
    return AlignmentRotation(frame, (w, x, y, z))


def encode_firmware(firmware: Firmware) -> bytes:
    """Return the data of FirmwareRev."""
    return _FIRMWARE.pack(*firmware)


def decode_firmware(data: bytes) -> Firmware | None:
    """Return a firmware revision; None if `data` is not one."""
    return Firmware(*_FIRMWARE.unpack(data)) if len(data) == _FIRMWARE.size else None


def decode_device_id(data: bytes) -> str:
    """Return the device identifier as printed on the label: at least eight hexadecimal digits."""
    return f"{int.from_bytes(data, 'big'):08X}"


def decode_text(data: bytes) -> str:
    """Return a product code or a label: ASCII, padded with spaces or zeros."""
    return data.decode("ascii", "replace").strip(" \0")


def decode_filter_profile(data: bytes) -> str:
    """Return a filter profile: the code of older devices, the label of newer ones."""
    if len(data) == _FILTER_CODE_BYTES:
        return str(int.from_bytes(data, "big"))
    return decode_text(data)


def baud_of_code(code: int) -> int | None:
    """Return the speed for a code, bit/s; None for an unknown code."""
    return _BAUD_OF_CODE.get(code)


def code_of_baud(baud: int) -> int | None:
    """Return the code for a speed; None if the device does not support it."""
    return _CODE_OF_BAUD.get(baud)


def error_text(code: int) -> str:
    """Return a description of error `code`."""
    return f"error 0x{code:02X}, {ERRORS.get(code, 'unknown to this version')}"


def fine_time_modulus(product_code: str) -> int | None:
    """Return the ticks after which SampleTimeFine wraps; None for an unknown model."""
    model = re.search(r"MTi-(?:G-)?(\d+)", product_code)
    if model is None:
        return None
    return WRAP_DAY if int(model[1]) in _DAY_WRAP_MODELS else WRAP_32_BIT
