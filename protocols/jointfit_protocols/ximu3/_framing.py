"""Conversion of the bytes of an x-IMU3 to messages, which are lines that end with LF.

A line that is not a message may still end with a message, if the terminator before the message was
lost. The end of such a line is therefore searched for a message at every byte.

Invariant: the codec converts bytes to messages. It uses no port and no clock, and the boundaries of
the byte strings do not matter.
"""

from __future__ import annotations

import re

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.ximu3._messages import (
    ESCAPE,
    LAYOUTS,
    TERMINATOR,
    MessageFault,
    XImu3Data,
    XImu3Reply,
    parse_line,
    parse_rest,
    unstuff,
)

MAX_LINE = 4096
"""Longest message including its terminator, bytes, which is the buffer size of the vendor's
software."""
_SEARCHED = 256
"""Number of bytes at the end of a corrupt line that are searched for a message. Every message with
numbers is shorter."""
_MOST_PENDING = MAX_LINE + _SEARCHED
_NEVER = 1 << 62
"""Modulus that converts -1, the result of a search without a match, to a number above every
position."""
_QUATERNION = (0xD1, 26)
"""First byte and size of a binary message with a quaternion."""
_SHORTEST_RUN = 4
"""Smallest number of consecutive messages of one kind that are decoded together."""
_LONGEST_RUN = 64
"""Largest number of messages decoded together. It limits the number of bytes that a failed attempt
reads."""
_TERMINATORS = bytes((TERMINATOR,)) * _LONGEST_RUN
_new_data = tuple.__new__
"""Constructor of a message from all of its fields. It takes half of the time of the usual
constructor."""
_TOO_LONG = f"line longer than {MAX_LINE} bytes"
_CUT_OFF = "cut off"
_STARTS = re.compile(
    b"[{" + b"".join(re.escape(bytes((first, first ^ 0x80))) for first, _ in sorted(LAYOUTS)) + b"]"
)
"""Pattern of the first bytes of messages that may follow a lost terminator."""

Found = XImu3Data | XImu3Reply | CorruptBytes


class XImu3Codec:
    """Codec that converts byte strings of any size to messages.

    A line without a message becomes one `CorruptBytes`, or several if the line is too long.
    """

    def __init__(self) -> None:
        self._pending = b""
        self._usual = _QUATERNION
        self._too_long = False  # whether the pending line lost its beginning
        self.fed = 0
        """Number of bytes fed so far."""
        self.messages = 0
        """Number of messages so far."""
        self.discarded = 0
        """Number of bytes so far that belong to no message."""

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete message in the buffer, always less than 4352."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[Found]:
        """Return the messages that `data` completes, in wire order; never raise."""
        found: list[Found] = []
        buffer = self._pending + data if self._pending else data
        append, count = found.append, 0
        at, base = 0, self.fed - len(self._pending)
        self.fed += len(data)

        # Most lines are binary messages of one kind, whose layout is known even if they contain
        # escapes.
        (first, size), (kind, layout) = self._usual, LAYOUTS[self._usual]
        size, unpack_from, find = 0 if self._too_long else size, layout.unpack_from, buffer.find
        escape, run_from = find(ESCAPE) % _NEVER, 0
        while (after := find(TERMINATOR, at) + 1) > 0:
            if after - at == size and buffer[at] == first and after <= escape:
                # A run of such lines is decoded together. A failed attempt is not repeated within
                # the run.
                here = min((min(escape, len(buffer)) - at) // size, _LONGEST_RUN)
                if here >= _SHORTEST_RUN and at >= run_from:
                    run_from = at + here * size
                    run = _decode_run(buffer[at:run_from], self._usual, base + at)
                    if run:
                        found += run
                        count += here
                        at = run_from
                        continue

                read = unpack_from(buffer, at)
                fields = (kind, read[0], read[1:], b"", True, size, base + after, None)
                append(_new_data(XImu3Data, fields))
                count += 1
                at = after
                continue

            if escape < after:
                escape = find(ESCAPE, after) % _NEVER
                plain = unstuff(buffer[at:after]) if buffer[at] == first else None
                if plain is not None and len(plain) == size:
                    read = unpack_from(plain)
                    fields = (kind, read[0], read[1:], b"", True, after - at, base + after, None)
                    append(_new_data(XImu3Data, fields))
                    count += 1
                    at = after
                    continue

            message = self._message(buffer[at:after], base + after, found)
            if message is not None:
                self.messages += 1
                found.append(message)
                usual = (buffer[at], after - at)
                if usual in LAYOUTS:
                    self._usual = usual
                    (first, size), (kind, layout) = usual, LAYOUTS[usual]
                    unpack_from = layout.unpack_from
            at = after

        self.messages += count
        self._pending = self._drop_start(buffer[at:], found) if at < len(buffer) else b""
        return found

    def flush(self) -> list[Found]:
        """Discard an incomplete message; return the pending bytes as corrupt."""
        found: list[Found] = []
        self._discard(len(self._pending), _TOO_LONG if self._too_long else _CUT_OFF, found)
        self._pending, self._too_long = b"", False
        return found

    def _message(self, line: bytes, end: int, found: list[Found]) -> XImu3Data | XImu3Reply | None:
        """Return the message of a line, and append the bytes before it to `found` as corrupt."""
        if self._too_long or len(line) > MAX_LINE:
            line, reason = self._drop_start(line, found), _TOO_LONG
            self._too_long = False
        else:
            message = parse_line(line, end)
            if not isinstance(message, MessageFault):
                return message
            reason = message.reason

        # The terminator of an earlier message may be lost, so the end of the line is searched.
        first = max(len(line) - _SEARCHED, 0)
        for start in _STARTS.finditer(line, first):
            rest = parse_rest(line[start.start() :], end)
            if rest is not None:
                self._discard(start.start(), reason, found)
                return rest
        self._discard(len(line), reason, found)
        return None

    def _drop_start(self, line: bytes, found: list[Found]) -> bytes:
        """Return the end of a line that is too long, and append the bytes before it as corrupt."""
        blocks = max(len(line) - _MOST_PENDING + MAX_LINE, 0) // MAX_LINE
        for _ in range(blocks):
            self._too_long = True
            self._discard(MAX_LINE, _TOO_LONG, found)
        return line[blocks * MAX_LINE :]

    def _discard(self, count: int, reason: str, found: list[Found]) -> None:
        if count:
            self.discarded += count
            found.append(CorruptBytes(count, reason))


def _decode_run(run: bytes, usual: tuple[int, int], end: int) -> list[XImu3Data]:
    """Return the messages of a run without escapes; empty if one of its lines is not `usual`.

    Parameters
    ----------
    run : bytes
        Bytes whose number is a multiple of the usual size.
    usual : tuple of int
        First byte and size of each message.
    end : int
        Number of bytes fed before the run.
    """
    first, size = usual
    count = len(run) // size
    if (
        run[size - 1 :: size] != _TERMINATORS[:count]
        or run.count(TERMINATOR) != count
        or run[::size].count(first) != count
    ):
        return []

    kind, layout = LAYOUTS[usual]
    new = _new_data
    return [
        new(XImu3Data, (kind, read[0], read[1:], b"", True, size, end := end + size, None))
        for read in layout.iter_unpack(run)
    ]
