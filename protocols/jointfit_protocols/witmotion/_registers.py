"""Commands that write and read the registers of WitMotion IMUs.

    FF AA register low high      write; accepted for 10 s after `UNLOCK`, never acknowledged
    FF AA 27 register high       read; answered with a frame 0x5F, but not by older firmware

Written registers take effect at once. Only `SAVE` stores them in flash.

Source: protocol pages of the vendor (Standard Communication Protocol).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

COMMAND_BYTES = 5
"""Length of every command, bytes."""
_COMMAND = struct.Struct("<BBBH")
_HEAD = (0xFF, 0xAA)
_FIRST_KIND = 0x50


class WitMotionRegister(IntEnum):
    """Numbers of registers."""

    SAVE = 0x00
    CONTENT = 0x02
    """Kinds of frames to send: bit n selects the kind 0x50 + n."""
    RATE = 0x03
    BAUD = 0x04
    MOUNTING = 0x23
    """Mounting: 0 horizontal, 1 vertical."""
    ALGORITHM = 0x24
    """Algorithm: 0 with magnetometer (nine axes), 1 without (six axes)."""
    READ = 0x27
    """Register of the read command. A register number written to it requests this register and the
    next three registers."""
    VERSION = 0x2E
    """Firmware version."""
    KEY = 0x69
    """Register of the unlock command. `_UNLOCKED` written to it permits writing for 10 s."""


_UNLOCKED = 0xB588
RATE_CODES = {10: 0x06, 20: 0x07, 50: 0x08, 100: 0x09, 200: 0x0B}
"""Values of the register `RATE` for each rate in Hz."""
BAUD_CODES = {
    4_800: 0x01, 9_600: 0x02, 19_200: 0x03, 38_400: 0x04, 57_600: 0x05, 115_200: 0x06,
    230_400: 0x07, 460_800: 0x08, 921_600: 0x09,
}  # fmt: skip
"""Values of the register `BAUD` for each speed in bit/s."""


class WitMotionCommand(NamedTuple):
    """A command that writes to a register."""

    register: int
    value: int


def write_register(register: int, value: int) -> bytes:
    """Return the command that writes `value`, 0 to 65535, to a register."""
    return _COMMAND.pack(*_HEAD, register, value)


def read_register(register: int) -> bytes:
    """Return the command that requests a register and the next three registers."""
    return write_register(WitMotionRegister.READ, register)


def decode_command(data: bytes) -> WitMotionCommand | None:
    """Return the command in five bytes; None if they are not a command."""
    if len(data) != COMMAND_BYTES or (data[0], data[1]) != _HEAD:
        return None
    return WitMotionCommand(*_COMMAND.unpack(data)[2:])


def content_bits(*kinds: int) -> int:
    """Return the value of the register `CONTENT` for these kinds of frames."""
    return sum(1 << (kind - _FIRST_KIND) for kind in set(kinds))


UNLOCK = write_register(WitMotionRegister.KEY, _UNLOCKED)
"""Command that permits writing for 10 s."""
SAVE = write_register(WitMotionRegister.SAVE, 0)
"""Command that stores all registers in flash."""
