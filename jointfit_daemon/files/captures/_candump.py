"""Conversion of ``candump`` text to CAN chunks.

    (1436509052.249713) can0 105#2A366C2B       eight identifier digits: 29 bits; #R: remote
    (1436509052.249713)  can0  105   [4]  2A 36 6C 2B       without -L; the time may be missing

A chunk is one record of `jointfit_protocols.can` with 24 bytes: i64 time in ns, u32 identifier, u8
flags, u8 size, two zero bytes, eight data bytes. This module packs the record itself, because the
daemon does not import wire formats. A test compares both implementations. A line that is not a
classic CAN frame becomes a record that states the number of its bytes, so that the decoder counts
them as lost.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING

from jointfit_daemon.model import Chunk

if TYPE_CHECKING:
    from collections.abc import Iterator

RECORD_BYTES = 24
"""Size of a record, bytes."""

_RECORD = struct.Struct("<qIBBxx8s")
_EXTENDED, _REMOTE, _ERROR = 1, 2, 4
_LOST_BYTES = 1 << 27
_ERROR_BIT = 1 << 29
_STANDARD_DIGITS = 3
_STANDARD_MAX, _EXTENDED_MAX = 0x7FF, 0x1FFF_FFFF
_LINE = re.compile(
    rb"\((\d{1,10})(?:\.(\d{1,9}))?\)\s+\S+\s+"
    rb"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(?:([Rr])\d?|((?:[0-9A-Fa-f]{2}){0,8}))(?:\s+[RT])?"
)

_PLAIN_LINE = re.compile(
    rb"(?:\((\d{1,10})(?:\.(\d{1,9}))?\)\s+)?\S+\s+(?:[RT]X\s+\S+\s+\S+\s+)?"
    rb"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[\d\](?:\s+(remote request)|((?:\s+[0-9A-Fa-f]{2}){0,8}))"
    rb"(?:\s+'.*'|\s+ERRORFRAME)?"
)


def is_candump(data: bytes) -> bool:
    """Return whether the first line that is neither empty nor a comment is ``candump`` output."""
    for line in data[:4096].splitlines():
        text = line.strip()
        if text and not text.startswith(b"#"):
            log = re.match(rb"\(\d+\.?\d*\)\s+\S+\s+[0-9A-Fa-f]+#", text)
            return (log or _PLAIN_LINE.fullmatch(text)) is not None
    return False


def read_candump(data: bytes) -> Iterator[Chunk]:
    """Yield one chunk of one record for each line; empty lines and comments yield none."""
    t_ns = 0
    for line in data.splitlines(keepends=True):
        text = line.strip()
        if not text or text.startswith(b"#"):
            continue

        found = _record(text, t_ns)
        if found is None:
            lost = len(line).to_bytes(8, "little")
            yield Chunk(t_ns, _RECORD.pack(t_ns, _LOST_BYTES, _ERROR, 8, lost))
        else:
            t_ns, record = found
            yield Chunk(t_ns, record)


def pack_can_frame(
    t_ns: int,
    number: int,
    data: bytes,
    *,
    extended: bool = False,
    remote: bool = False,
    error: bool = False,
) -> bytes:
    """Return the record of one frame with identifier `number`, received at `t_ns`."""
    flags = _EXTENDED * extended | _REMOTE * remote | _ERROR * error
    return _RECORD.pack(t_ns, number, flags, len(data), data)


def frame_sizes(records: bytes) -> dict[tuple[int, bool], int]:
    """Return the number of data bytes in the last frame of each identifier in `records`.

    A key consists of an identifier and a flag, which is true if the identifier has 29 bits. Error
    and remote frames are ignored.
    """
    whole = len(records) // RECORD_BYTES * RECORD_BYTES
    return {
        (number, bool(flags & _EXTENDED)): size
        for _, number, flags, size, _ in _RECORD.iter_unpack(records[:whole])
        if not flags & (_REMOTE | _ERROR)
    }


def _record(line: bytes, before_ns: int) -> tuple[int, bytes] | None:
    """Return time and record of one line; None if it is not a classic CAN frame.

    A line without time has the time of the line before.
    """
    match = _LINE.fullmatch(line) or _PLAIN_LINE.fullmatch(line)
    if match is None:
        return None
    seconds, fraction, digits, remote, body = match.groups()
    t_ns = before_ns
    if seconds:
        t_ns = int(seconds) * 10**9 + int((fraction or b"0").ljust(9, b"0"))
    if t_ns >= 2**63:  # the time does not fit into a record
        return None
    number, extended = int(digits, 16), len(digits) > _STANDARD_DIGITS
    error = bool(extended and number & _ERROR_BIT)
    number &= ~_ERROR_BIT
    if number > (_EXTENDED_MAX if extended else _STANDARD_MAX):
        return None

    payload = bytes.fromhex((body or b"").decode())
    kind = _ERROR if error else _EXTENDED * extended
    flags = kind | _REMOTE * (remote is not None)
    return t_ns, _RECORD.pack(t_ns, number, flags, len(payload), payload)
