"""Bytes of an x-IMU3 to messages: lines that end with LF.

A line that is no message may still end with one, because the terminator before it was lost. Its
last bytes are therefore searched for a message, one byte after the other.

Invariant: bytes in, messages out; no port, no clock. The result does not depend on the pieces.
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
    unstuffed,
)

MAX_LINE = 4096
"""Longest message, bytes, terminator included: the buffer of the vendor's software."""
_SEARCHED = 256
"""Last bytes of a corrupt line that are searched for a message: more than any with numbers."""
_MOST_PENDING = MAX_LINE + _SEARCHED
_NEVER = 1 << 62
"""Modulus that makes -1, the result of a search without a match, larger than every position."""
_QUATERNION = (0xD1, 26)
"""First byte and size of a binary quaternion."""
_SHORTEST_RUN = 4
"""Messages of one kind in a row from which they are decoded together."""
_LONGEST_RUN = 64
"""Most messages decoded together; bounds the bytes that a failed attempt has read."""
_TERMINATORS = bytes((TERMINATOR,)) * _LONGEST_RUN
_new_data = tuple.__new__
"""Constructor of a message from all of its fields, in half of the time of its own."""
_TOO_LONG = f"line longer than {MAX_LINE} bytes"
_CUT_OFF = "cut off"
_STARTS = re.compile(
    b"[{" + b"".join(re.escape(bytes((first, first ^ 0x80))) for first, _ in sorted(LAYOUTS)) + b"]"
)
"""First bytes of messages that may follow a lost terminator."""

Found = XImu3Data | XImu3Reply | CorruptBytes


class XImu3Codec:
    """Decoder of pieces of any size to messages.

    A line without a message becomes one `CorruptBytes`; a line that is too long becomes several.
    """

    def __init__(self) -> None:
        self._pending = b""
        self._usual = _QUATERNION
        self._too_long = False  # whether the pending line lost its beginning
        self.fed = 0
        """Number of bytes fed so far."""
        self.messages = 0
        """Messages so far."""
        self.discarded = 0
        """Number of bytes so far that belong to no message."""

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete message in the buffer, fewer than 4352."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[Found]:
        """Return the messages that `data` completed, in wire order; never raises."""
        found: list[Found] = []
        buffer = self._pending + data if self._pending else data
        append, count = found.append, 0
        at, base = 0, self.fed - len(self._pending)
        self.fed += len(data)

        # Most lines are binary messages of one kind: their layout is known, also after escapes.
        (first, size), (kind, layout) = self._usual, LAYOUTS[self._usual]
        size, unpack_from, find = 0 if self._too_long else size, layout.unpack_from, buffer.find
        escape, run_from = find(ESCAPE) % _NEVER, 0
        while (after := find(TERMINATOR, at) + 1) > 0:
            if after - at == size and buffer[at] == first and after <= escape:
                # A run of such lines is decoded at once; a failed attempt is not repeated inside.
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
                plain = unstuffed(buffer[at:after]) if buffer[at] == first else None
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
        self._pending = self._shortened(buffer[at:], found) if at < len(buffer) else b""
        return found

    def flush(self) -> list[Found]:
        """End the input, or a silence: return the pending bytes as corrupt."""
        found: list[Found] = []
        self._discard(len(self._pending), _TOO_LONG if self._too_long else _CUT_OFF, found)
        self._pending, self._too_long = b"", False
        return found

    def _message(self, line: bytes, end: int, found: list[Found]) -> XImu3Data | XImu3Reply | None:
        """Return the message of a line; bytes before it are appended to `found` as corrupt."""
        if self._too_long or len(line) > MAX_LINE:
            line, reason = self._shortened(line, found), _TOO_LONG
            self._too_long = False
        else:
            message = parse_line(line, end)
            if not isinstance(message, MessageFault):
                return message
            reason = message.reason

        # The terminator of an earlier message may be lost: search the end of the line.
        first = max(len(line) - _SEARCHED, 0)
        for start in _STARTS.finditer(line, first):
            rest = parse_rest(line[start.start() :], end)
            if rest is not None:
                self._discard(start.start(), reason, found)
                return rest
        self._discard(len(line), reason, found)
        return None

    def _shortened(self, line: bytes, found: list[Found]) -> bytes:
        """Return the last bytes of a line that is too long; those before them are corrupt."""
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
    """Return the messages of a run without escapes; empty if not all of its lines are `usual`.

    Parameters
    ----------
    run : bytes
        Whole multiples of the usual size.
    usual : tuple of int
        First byte and size of each message.
    end : int
        Bytes fed before the run.
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
