"""ASCII messages of VectorNav devices: requests, their replies, and asynchronous outputs.

    $VNRRG,75*4B CR LF      read register 75         $VNRRG,75,2,8,01,0011*XX     its reply
    $VNWRG,75,3,8,01,0011*XX  write it, until power-down; the reply repeats it
    $VNASY,0*XX             pause asynchronous output; 1 resumes it
    $VNWNV*57               store all registers
    $VNERR,07*XX            error instead of a reply

The checksum is the exclusive or of the characters between ``$`` and ``*`` (two hexadecimal digits),
or their CRC-16 (four digits).

Source: VN-100 user manual (UM001), sections 3 to 6.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from contextlib import suppress
from functools import reduce
from operator import xor
from typing import NamedTuple

START, END = b"$", b"\r\n"
MAX_TEXT = 512
"""Longest message, bytes. The messages in the manual have up to 200 bytes."""
_TEXT = re.compile(rb"\$(VN[A-Z]{3}[ -)+-~]*)\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})\r\n")
"""Pattern of a complete message. Its content has printable characters except the asterisk."""
PLAUSIBLE = re.compile(rb"\$(V(N[ -~]*(\r(\n)?)?)?)?")
"""Pattern of the beginning of a message."""

ERRORS = {
    1: "hard fault",
    2: "serial buffer overflow",
    3: "invalid checksum",
    4: "invalid command",
    5: "not enough parameters",
    6: "too many parameters",
    7: "invalid parameter",
    8: "invalid register",
    9: "unauthorized access",
    10: "watchdog reset",
    11: "output buffer overflow: the rate is too high for the baud rate",
    12: "insufficient baud rate",
    255: "error buffer overflow",
}


class TextMessage(NamedTuple):
    """One ASCII message whose checksum is correct."""

    command: str
    """Name of the command, such as ``VNRRG``."""
    values: tuple[str, ...]
    """Values that follow the command."""
    size: int
    """Length of the message on the wire, bytes."""
    end: int = 0
    """Number of bytes fed to the codec until the end of the message."""

    @property
    def register(self) -> int | None:
        """Number of the register that a reply refers to; None for other messages."""
        about = self.command in {"VNRRG", "VNWRG"} and self.values
        return int(self.values[0]) if about and self.values[0].isdecimal() else None

    @property
    def error(self) -> int | None:
        """Code of an error message, 0 if it is unknown; None for other messages."""
        if self.command != "VNERR" or not self.values:
            return None
        # The vendor's library reads the code as hexadecimal, but some firmware sends it as decimal:
        # 0C or 12.
        for base in (16, 10):
            with suppress(ValueError):
                code = int(self.values[0], base)
                if code in ERRORS:
                    return code
        return 0


def decode_text(wire: bytes, end: int) -> TextMessage | None:
    """Return the message on the wire; None if it is malformed or its checksum is wrong."""
    found = _TEXT.fullmatch(wire)
    if found is None:
        return None
    content, digits = found.groups()
    expected = reduce(xor, content) if len(digits) == 2 else crc_hqx(content, 0)  # noqa: PLR2004 - two digits of eight bits
    if int(digits, 16) != expected:
        return None
    command, *values = content.decode("ascii").split(",")
    return TextMessage(command, tuple(values), len(wire), end)


def encode_text(content: str) -> bytes:
    """Return the bytes of a message, such as ``VNRRG,1``, on the wire.

    Raises
    ------
    ValueError
        The content is not such a message, or is too long.
    """
    data = content.encode("ascii")
    wire = START + data + b"*%02X" % reduce(xor, data, 0) + END
    if len(wire) > MAX_TEXT or not _TEXT.fullmatch(wire):
        raise ValueError(f"{content!r} is no message: expected VNxxx with printable characters")
    return wire


def error_text(code: int) -> str:
    """Return the description of an error code."""
    return f"error {code}, {ERRORS.get(code, 'unknown to this version')}"
