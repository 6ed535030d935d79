"""Commands and settings of LPMS sensors, for both generations.

Both generations use the same message format, but some numbers mean different commands. A command
that reads a setting in one generation may write a setting in the other:

| purpose               | generation 1                       | generation 3                     |
|-----------------------|------------------------------------|----------------------------------|
| models                | B2, CU2, URS2, CURS2, AL2, ME1     | LPMS3, IG1, BE1, NAV3            |
| command / stream mode | 06 / 07                            | 06 / 07                          |
| data packet           | 09                                 | 09                               |
| outputs               | set 0A, read 04                    | set 1E, read 1F                  |
| rate, Hz              | set 0B, read 04 (a code)           | set 22, read 23                  |
| precision             | set 4B (1: 16 bit), read 04 bit 22 | set 88 (1: 32 bit), read 89      |
| store in flash        | 0F                                 | 04                               |
| factory reset         | 10                                 | 05                               |
| firmware              | 2F: patch, minor, major            | 15: text                         |
| 5B                    | device name, text                  | filter mode, U4                  |

U4 is an unsigned integer of 4 bytes.

Settings are lost at power-off unless they are stored: according to the firmware source of 2013, a
command changes only the memory, not the flash.

Source: the vendor's register headers (OpenMAT), protocol pages and firmware source of 2013. The
command 5B was not tested on hardware; the headers of both generations list it as a read command.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple

Generation = Literal[1, 3]

_WORD = struct.Struct("<I")
_VERSION = struct.Struct("<3I")
_SIXTEEN_BIT = 1 << 22
"""Bit of the configuration word in generation 1: the data are int16."""
_RATE_CODE = 0x7
"""Bits of the configuration word in generation 1 that contain the code of the rate."""
SECONDS_UP_TO = (1, 3, 4)
"""Newest firmware of generation 1 whose device time is float32 seconds."""


class LpmsCommand(IntEnum):
    """Command numbers of sensors of generation 1 and of generation 3."""

    ACK = 0x00
    NACK = 0x01
    COMMAND_MODE = 0x06
    STREAM_MODE = 0x07
    DATA = 0x09
    IDENTIFY = 0x5B
    """Read command that returns the device name in generation 1 and the filter mode in generation
    3."""


class LpmsOutput(NamedTuple):
    """One quantity that a data packet may contain."""

    name: str
    bit: int
    """Bit of the output mask that enables the quantity."""
    values: int = 3


@dataclass(frozen=True, slots=True)
class CommandTable:
    """Commands and outputs of one sensor generation."""

    generation: Generation
    models: str
    outputs: tuple[LpmsOutput, ...]
    """Outputs in the order in which a data packet contains them."""
    rates_hz: tuple[int, ...]
    tick_hz: int
    """Default rate of the device time, ticks per second."""
    set_outputs: int
    set_rate: int
    set_precision: int
    store: int
    factory_reset: int
    read_firmware: int
    reads: tuple[int, ...]
    """Commands that read the settings of outputs, rate and precision."""

    @property
    def quaternion(self) -> int:
        """Output mask for the quaternion alone."""
        return self.mask("quaternion")

    def mask(self, *names: str) -> int:
        """Return the output mask of the named outputs."""
        return sum(1 << output.bit for output in self.outputs if output.name in names)

    def names(self, mask: int) -> list[str]:
        """Return the names of the outputs in `mask`."""
        return [output.name for output in self.outputs if mask >> output.bit & 1]


GENERATION_1 = CommandTable(
    generation=1,
    models="B2, CU2, URS2, CURS2, AL2, ME1",
    outputs=(
        LpmsOutput("gyro_raw", 12),
        LpmsOutput("accelerometer_raw", 11),
        LpmsOutput("magnetometer_raw", 10),
        LpmsOutput("angular_velocity", 16),
        LpmsOutput("quaternion", 18, 4),
        LpmsOutput("euler", 17),
        LpmsOutput("linear_acceleration", 21),
        LpmsOutput("pressure", 9, 1),
        LpmsOutput("altitude", 19, 1),
        LpmsOutput("temperature", 13, 1),
        LpmsOutput("heave", 14, 1),
    ),
    rates_hz=(5, 10, 25, 50, 100, 200, 400),
    tick_hz=400,
    set_outputs=0x0A,
    set_rate=0x0B,
    set_precision=0x4B,
    store=0x0F,
    factory_reset=0x10,
    read_firmware=0x2F,
    reads=(0x04,),
)
GENERATION_3 = CommandTable(
    generation=3,
    models="LPMS3, IG1, BE1, NAV3",
    outputs=(
        LpmsOutput("accelerometer_raw", 0),
        LpmsOutput("accelerometer", 1),
        LpmsOutput("gyro0_raw", 2),
        LpmsOutput("gyro1_raw", 3),
        LpmsOutput("gyro0_bias_calibrated", 4),
        LpmsOutput("gyro1_bias_calibrated", 5),
        LpmsOutput("gyro0", 6),
        LpmsOutput("gyro1", 7),
        LpmsOutput("magnetometer_raw", 8),
        LpmsOutput("magnetometer", 9),
        LpmsOutput("angular_velocity", 10),
        LpmsOutput("quaternion", 11, 4),
        LpmsOutput("euler", 12),
        LpmsOutput("linear_acceleration", 13),
        LpmsOutput("pressure", 14, 1),
        LpmsOutput("altitude", 15, 1),
        LpmsOutput("temperature", 16, 1),
    ),
    rates_hz=(5, 10, 50, 100, 250, 500, 1000),
    tick_hz=500,
    set_outputs=0x1E,
    set_rate=0x22,
    set_precision=0x88,
    store=0x04,
    factory_reset=0x05,
    read_firmware=0x15,
    reads=(0x1F, 0x23, 0x89),
)
TABLES: dict[int, CommandTable] = {1: GENERATION_1, 3: GENERATION_3}


class LpmsConfiguration(NamedTuple):
    """Settings that determine the data packets; None for unknown settings."""

    outputs: int | None = None
    """Mask of the enabled outputs."""
    rate_hz: int | None = None
    floats: bool | None = None
    """Whether values are float32; otherwise they are int16."""

    def merge(self, part: LpmsConfiguration) -> LpmsConfiguration:
        """Return these settings, updated with the known settings of `part`."""
        known = {key: value for key, value in part._asdict().items() if value is not None}
        return self._replace(**known)


def decode_configuration(
    table: CommandTable, command: int, data: bytes
) -> LpmsConfiguration | None:
    """Return the settings in a reply to one of `table.reads`; None for any other reply."""
    if command not in table.reads or len(data) != _WORD.size:
        return None
    (word,) = _WORD.unpack(data)

    if table.generation == 1:
        mask = sum(1 << output.bit for output in table.outputs) & word
        code = word & _RATE_CODE
        rate_hz = table.rates_hz[code] if code < len(table.rates_hz) else None
        return LpmsConfiguration(mask, rate_hz, not word & _SIXTEEN_BIT)

    outputs, rate, _ = table.reads
    if command == outputs:
        return LpmsConfiguration(outputs=word)
    if command == rate:
        return LpmsConfiguration(rate_hz=word)
    return LpmsConfiguration(floats=bool(word))


def encode_configuration(
    table: CommandTable, command: int, configuration: LpmsConfiguration
) -> bytes:
    """Return the data of the reply to one of `table.reads`, as a device sends it.

    Raises
    ------
    ValueError
        A setting is None, or the generation does not have it.
    """
    mask, rate_hz, floats = configuration
    if mask is None or rate_hz is None or floats is None:
        raise ValueError(f"{configuration}: every setting must be known")
    if table.generation == 1:
        code = table.rates_hz.index(rate_hz)
        return _WORD.pack(mask | code | (0 if floats else _SIXTEEN_BIT))
    return _WORD.pack((mask, rate_hz, int(floats))[table.reads.index(command)])


def set_command(table: CommandTable, part: LpmsConfiguration) -> list[tuple[int, bytes]]:
    """Return the commands, each with its data, that set all known settings of `part`."""
    commands = []
    if part.outputs is not None:
        commands.append((table.set_outputs, _WORD.pack(part.outputs)))
    if part.rate_hz is not None:
        commands.append((table.set_rate, _WORD.pack(part.rate_hz)))
    if part.floats is not None:
        # The flag for 16 or 32 bits has opposite meanings in the two generations.
        value = part.floats if table.generation == 3 else not part.floats  # noqa: PLR2004 - a generation
        commands.append((table.set_precision, _WORD.pack(int(value))))
    return commands


def decode_set(table: CommandTable, command: int, data: bytes) -> LpmsConfiguration | None:
    """Return the setting that a command sets; None if the command sets none."""
    if len(data) != _WORD.size:
        return None
    (word,) = _WORD.unpack(data)
    if command == table.set_outputs:
        return LpmsConfiguration(outputs=word)
    if command == table.set_rate:
        return LpmsConfiguration(rate_hz=word)
    if command == table.set_precision:
        return LpmsConfiguration(floats=bool(word) == (table.generation == 3))  # noqa: PLR2004 - a generation
    return None


def decode_firmware(table: CommandTable, data: bytes) -> str | None:
    """Return the firmware version; None if `data` contains none."""
    if table.generation == 1:
        if len(data) != _VERSION.size:
            return None
        patch, minor, major = _VERSION.unpack(data)
        return f"{major}.{minor}.{patch}"
    return decode_text(data) or None


def encode_firmware(table: CommandTable, version: str) -> bytes:
    """Return the data of the reply with the firmware version, as a device sends it."""
    if table.generation == 1:
        major, minor, patch = map(int, version.split("."))
        return _VERSION.pack(patch, minor, major)
    return version.encode("ascii").ljust(24, b"\0")


def sends_seconds(version: str) -> bool:
    """Return whether firmware `version` of generation 1 sends its time as float32 seconds."""
    parts = tuple(int(part) if part.isdigit() else 0 for part in version.split("."))
    return parts <= SECONDS_UP_TO


def identify_generation(data: bytes) -> Generation | None:
    """Return the generation that replies with `data` to `LpmsCommand.IDENTIFY`; None if unknown."""
    if len(data) == _WORD.size and data[1:] == bytes(3):
        return 3
    text = data.rstrip(b"\0")
    return 1 if text and all(0x20 <= byte < 0x7F for byte in text) else None  # noqa: PLR2004 - ASCII


def decode_text(data: bytes) -> str:
    """Return an ASCII text without spaces, zeros and line ends before and after it."""
    return data.decode("ascii", "replace").strip(" \0\r\n")
