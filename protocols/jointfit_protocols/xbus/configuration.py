"""Payloads of the Xbus messages that configure a device.

    OutputConfiguration   N x | DataID U2 | rate U2 |                                   N <= 32
    SyncSettings          N x | function | line | polarity | once | skipFirst U2 | skipFactor U2
                              | pulseWidth U2, 100 us | delay U2, 100 us, or period, ms |   N <= 10
    AlignmentRotation         | frame U1: 0 sensor, 1 local | w x y z float32 |
    FirmwareRev               | major | minor | revision | build U4 | scm U4 |

U1, U2 and U4 are unsigned integers of 1, 2 and 4 bytes. Fields without a type have 1 byte.

Source: MT0101P rev. 2020.A.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_RATE = 0xFFFF
"""Value that requests the highest possible rate. Time and status items always report this value."""
TICK_NS = 100_000
"""Duration of one tick of SampleTimeFine, ns."""
WRAP_32_BIT = 1 << 32
"""Number of ticks after which SampleTimeFine of most models wraps."""
WRAP_DAY = 864_000_000
"""Number of ticks after which SampleTimeFine of the MTi-10 and MTi-100 series wraps, at
midnight."""

ERRORS = {
    0x03: "period out of range",
    0x04: "message invalid",
    0x1E: "output buffer overflow: the rate is too high for the baud rate",
    0x20: "baud rate out of range",
    0x21: "parameter invalid or out of range",
    0x28: "device error",
}
_DAY_WRAP_MODELS = {10, 20, 30, 100, 200, 300, 700, 710}
"""Models of the MTi-10 and MTi-100 series."""
_OUTPUT = struct.Struct(">HH")
_SYNC = struct.Struct(">BBBBHHHH")
_FIRMWARE = struct.Struct(">BBBII")
_ROTATION = struct.Struct(">B4f")
_FILTER_CODE_BYTES = 2


class Output(NamedTuple):
    """One entry of an output configuration."""

    data_id: int
    rate: int
    """Output rate, Hz; 0 or 0xFFFF means the highest possible rate."""


class SyncSetting(NamedTuple):
    """One entry of the list of synchronisation settings. A new list replaces the old list."""

    function: int
    """Function of the line: 3 trigger indication, 4 SyncOut, 8 send latest, 9 clock bias, 11 start
    sampling, 14 1PPS."""
    line: int
    polarity: int
    """Polarity: 1 rising, 2 falling, 3 both, 0 off."""
    once: int = 0
    skip_first: int = 0
    skip_factor: int = 0
    pulse_width: int = 0
    """Width of the pulses on an output, in units of 100 us."""
    delay: int = 0
    """Delay, in units of 100 us. For clock bias estimation, it is the reference period, ms."""


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
    """Frame that the rotation changes: 0 sensor, 1 local (world)."""
    q: tuple[float, float, float, float]


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


def encode_alignment(rotation: AlignmentRotation) -> bytes:
    """Return the data of an alignment rotation."""
    return _ROTATION.pack(rotation.frame, *rotation.q)


def decode_alignment(data: bytes) -> AlignmentRotation | None:
    """Return the alignment rotation in `data`; None if `data` are malformed."""
    if len(data) != _ROTATION.size:
        return None
    frame, w, x, y, z = _ROTATION.unpack(data)
    return AlignmentRotation(frame, (w, x, y, z))


def encode_firmware(firmware: Firmware) -> bytes:
    """Return the data of FirmwareRev."""
    return _FIRMWARE.pack(*firmware)


def decode_firmware(data: bytes) -> Firmware | None:
    """Return the firmware revision in `data`; None if `data` are malformed."""
    return Firmware(*_FIRMWARE.unpack(data)) if len(data) == _FIRMWARE.size else None


def decode_device_id(data: bytes) -> str:
    """Return the device identifier as printed on the label: at least eight hexadecimal digits."""
    return f"{int.from_bytes(data, 'big'):08X}"


def decode_text(data: bytes) -> str:
    """Return a product code or a label: ASCII text without padding by spaces or zeros."""
    return data.decode("ascii", "replace").strip(" \0")


def decode_filter_profile(data: bytes) -> str:
    """Return a filter profile: the code for older devices, the label for newer devices."""
    if len(data) == _FILTER_CODE_BYTES:
        return str(int.from_bytes(data, "big"))
    return decode_text(data)


def error_text(code: int) -> str:
    """Return the description of an error code."""
    return f"error 0x{code:02X}, {ERRORS.get(code, 'unknown to this version')}"


def fine_time_modulus(product_code: str) -> int | None:
    """Return the number of ticks after which SampleTimeFine wraps; None for an unknown model."""
    model = re.search(r"MTi-(?:G-)?(\d+)", product_code)
    if model is None:
        return None
    return WRAP_DAY if int(model[1]) in _DAY_WRAP_MODELS else WRAP_32_BIT
