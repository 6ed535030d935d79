"""Binary frames of a serial device, described by a table.

     0       sync                                          length - end - checksum
    | sync | ... length, type, fields at fixed offsets ... | checksum | end |

The length is fixed, or a field of the frame plus a constant. The checksum includes all bytes from a
given one up to itself. A type field selects the frames with measurements; other valid frames are
skipped and counted.

Without checksum, a frame counts only if it continues the previous one, or if the start of the next
one follows it; otherwise sync bytes inside a frame would begin frames.

Invariant: bytes in, messages out; no port, no clock. The result does not depend on the pieces in
which the bytes arrive.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.table._checksums import Checksum, compile_checksum
from jointfit_protocols.table._fields import ByteOrder, FieldReader, TableField
from jointfit_protocols.table._messages import (
    CHECKSUM,
    CUT_OFF,
    NO_START,
    CorruptRun,
    TableItem,
    TableMessage,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

LONGEST_FRAME = 4096
"""Most bytes of a frame; it bounds the wait after a corrupt length."""


class FrameFormat(NamedTuple):
    """Description of the frames of a serial device."""

    sync: bytes
    """First bytes of every frame."""
    fields: Mapping[int, TableField]
    """Place of each slot of the record."""
    length: int | TableField
    """Bytes of a frame, or the field with a length."""
    length_adds: int = 0
    """Bytes of a frame minus its length field."""
    longest: int = LONGEST_FRAME
    """Most bytes of a frame with a length field."""
    checksum: Checksum | None = None
    end: bytes = b""
    """Last bytes of every frame."""
    message: tuple[TableField, int] | None = None
    """Type field and its value in the frames with measurements; None: all frames have them."""


class FrameCodec:
    """Decoder of pieces of any size to records; never raises.

    A run of bytes without a frame becomes one `CorruptBytes`.

    Parameters
    ----------
    form : FrameFormat
        Description of the frames.
    """

    def __init__(self, form: FrameFormat) -> None:
        self._form = form
        self.slots = tuple(sorted(form.fields))
        """Slots of a record, in its order."""
        self._reader = FieldReader([form.fields[slot] for slot in self.slots])
        self._read = self._reader.read

        checksum = form.checksum
        self._compute = None if checksum is None else compile_checksum(checksum)
        self._first = 0 if checksum is None else checksum.first
        self._width = 0 if checksum is None else checksum.width
        self._order: ByteOrder = "little" if checksum is None else checksum.byte_order
        self._tail = self._width + len(form.end)
        self._head = len(form.sync)
        self._fixed = form.length if isinstance(form.length, int) else 0
        if not isinstance(form.length, int):
            self._read_length = FieldReader([form.length]).read
            self._head = max(self._head, form.length.end)
        self._shortest = max(self._head + self._tail, len(form.sync) + 1)
        self._selects = None
        self._expected = 0
        if form.message is not None:
            self._selects, self._expected = FieldReader([form.message[0]]), form.message[1]

        self._pending = b""
        self._in_step = False  # whether a frame ended exactly before the pending bytes
        self._run = CorruptRun(form.longest if not self._fixed else max(self._fixed, 64))
        self.fed = 0
        """Bytes fed so far."""
        self.messages = 0
        """Frames so far, those of other types included."""
        self.skipped = 0
        """Valid frames of other types so far."""
        self.checksum_failures = 0
        """Complete candidates with a wrong checksum so far."""

    @property
    def discarded(self) -> int:
        """Bytes without a frame so far."""
        return self._run.discarded

    @property
    def pending(self) -> int:
        """Bytes of an incomplete frame."""
        return len(self._pending)

    @property
    def longest(self) -> int:
        """Most bytes of a frame."""
        return self._fixed or self._form.longest

    def feed(self, data: bytes) -> list[TableItem]:
        """Return the frames that `data` completed, in wire order; never raises."""
        return self._scan(data, final=False)

    def flush(self) -> list[TableItem]:
        """End the input, or a silence: return frames hidden in the pending bytes."""
        found = self._scan(b"", final=True)
        self._run.end(found)
        self._in_step = False
        return found

    def _scan(self, data: bytes, *, final: bool) -> list[TableItem]:
        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[TableItem] = []
        sync = self._form.sync

        at, end = 0, len(buffer)
        while at < end:
            if not buffer.startswith(sync, at):
                after = self._next_start(buffer, at, final=final)
                if after == at:  # the rest may be the first of the sync bytes
                    break
                self._skip(after - at, NO_START, found)
                at = after
                continue

            size = self._size(buffer, at)
            if size > end - at and not final:
                break
            reason = self._fault(buffer, at, size)
            if reason is None:  # without checksum: the bytes behind it decide
                if not final:
                    break
                reason = ""
            if reason:
                self._skip(1, reason, found)
                at += 1
            else:
                self._take(buffer, at, size, base, found)
                at += size
        self._pending = buffer[at:]
        return found

    def _next_start(self, buffer: bytes, at: int, *, final: bool) -> int:
        """Return the next place, from `at` on, where sync bytes begin, or may begin at the end."""
        sync, end = self._form.sync, len(buffer)
        found = buffer.find(sync, at)
        if found >= 0 or final:
            return found if found >= 0 else end
        for start in range(max(at, end - len(sync) + 1), end):
            if sync.startswith(buffer[start:]):
                return start
        return end

    def _size(self, buffer: bytes, at: int) -> int:
        """Return the bytes from `at` that are needed to decide about a frame there."""
        if self._fixed:
            return self._fixed
        if len(buffer) - at < self._head:
            return self._head
        (length,) = self._read_length(buffer, at)
        size = int(length) + self._form.length_adds
        return size if self._shortest <= size <= self._form.longest else self._head

    def _fault(self, buffer: bytes, at: int, size: int) -> str | None:
        """Return why no frame of `size` bytes starts at `at`; empty if one does, None: unknown."""
        stop = at + size
        if stop > len(buffer):
            return CUT_OFF
        if size < self._shortest:
            return _LENGTH
        form = self._form
        if form.end and not buffer.endswith(form.end, at, stop):
            return _END

        checked = stop - self._tail
        if self._compute is not None:
            sent = int.from_bytes(buffer[checked : checked + self._width], self._order)
            if self._compute(buffer[at + self._first : checked]) != sent:
                self.checksum_failures += 1
                return CHECKSUM
        elif not self._in_step:
            following = buffer[stop : stop + len(form.sync)]
            if following != form.sync:
                return None if form.sync.startswith(following) else _ALONE
        return ""

    def _take(self, buffer: bytes, at: int, size: int, base: int, found: list[TableItem]) -> None:
        """Append the record of a valid frame."""
        selects = self._selects
        wanted = selects is None or (
            size >= selects.size and selects.read(buffer, at)[0] == self._expected
        )
        if wanted and size - self._tail < self._reader.size:
            # a valid frame that is too short for the fields
            self._skip(size, f"frame of {size} bytes is too short for the fields", found)
            return

        self._run.end(found)
        self._in_step = True
        self.messages += 1
        if not wanted:
            self.skipped += 1
            return
        data = buffer[at : at + size]
        found.append(TableMessage(self._read(data, 0), data, base + at + size))

    def _skip(self, count: int, reason: str, found: list[TableItem]) -> None:
        self._in_step = False
        self._run.add(count, reason, found)


def encode_frame(form: FrameFormat, values: Sequence[float], size: int | None = None) -> bytes:
    """Return the frame of a record.

    Parameters
    ----------
    form : FrameFormat
        Description of the frame.
    values : sequence of float
        The record, as sent, in the order of its slots.
    size : int, optional
        Bytes of the frame; default: the fixed length, or the shortest frame with all fields.

    Raises
    ------
    struct.error, OverflowError
        A number does not fit its place.
    """
    slots = sorted(form.fields)
    reader = FieldReader([form.fields[slot] for slot in slots])
    width = 0 if form.checksum is None else form.checksum.width
    if size is None:
        shortest = reader.size + width + len(form.end)
        size = form.length if isinstance(form.length, int) else shortest

    frame = bytearray(size)
    frame[: len(form.sync)] = form.sync
    if not isinstance(form.length, int):
        FieldReader([form.length]).write(frame, [size - form.length_adds])
    if form.message is not None:
        FieldReader([form.message[0]]).write(frame, [form.message[1]])
    reader.write(frame, values)

    checked = size - width - len(form.end)
    if form.checksum is not None:
        total = compile_checksum(form.checksum)(bytes(frame[form.checksum.first : checked]))
        frame[checked : checked + width] = total.to_bytes(width, form.checksum.byte_order)
    frame[size - len(form.end) :] = form.end
    return bytes(frame)


_LENGTH = "length outside the format"
_END = "no end bytes"
_ALONE = "no frame follows, and frames have no checksum"
