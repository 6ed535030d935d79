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

import re
from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec
from jointfit_protocols.table._checksums import Checksum, compile_checksum
from jointfit_protocols.table._fields import ByteOrder, FieldReader, TableField
from jointfit_protocols.table._messages import TableItem, TableMessage

if TYPE_CHECKING:
    from collections.abc import Sequence

LONGEST_FRAME = 4096
"""Maximum size of a frame in bytes; it bounds the wait after a corrupt length."""


class FrameFormat(NamedTuple):
    """Description of the frames of a serial device."""

    sync: bytes
    """First bytes of every frame."""
    fields: Mapping[int, TableField]
    """Place of each slot of the record."""
    length: int | TableField
    """Length of a frame, bytes, or the field that contains a length."""
    length_adds: int = 0
    """Length of a frame minus the value of its length field, bytes."""
    longest: int = LONGEST_FRAME
    """Maximum size of a frame with a length field in bytes."""
    checksum: Checksum | None = None
    end: bytes = b""
    """Last bytes of every frame."""
    message: tuple[TableField, int] | None = None
    """Type field and its value in the frames with measurements; None: all frames have them."""


_NO_START = CorruptBytes(1, NO_START)
_CHECKSUM = CorruptBytes(1, CHECKSUM)
_LENGTH = CorruptBytes(1, "length outside the format")
_END = CorruptBytes(1, "no end bytes")
_ALONE = CorruptBytes(1, "no frame follows, and frames have no checksum")


class FrameCodec(ResynchronizingCodec[TableMessage]):
    """Decoder of pieces of any size to records; never raises.

    A run of bytes without a frame becomes one `CorruptBytes`. Frames of other types are messages
    that `feed` does not return.

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
        self._read_fields = self._reader.read

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
        self._shortest_frame = max(self._head + self._tail, len(form.sync) + 1)
        self._selects = None
        self._expected = 0
        if form.message is not None:
            self._selects, self._expected = FieldReader([form.message[0]]), form.message[1]

        longest_run = form.longest if not self._fixed else max(self._fixed, 64)
        super().__init__(self._read_frame, _start_pattern(form.sync), longest_run)
        self._in_step_at = -1  # bytes fed up to and including the previous frame
        self._is_final = False  # whether no further bytes can decide about a frame
        self.skipped = 0
        """Valid frames of other types so far."""

    @property
    def longest(self) -> int:
        """Maximum size of a frame in bytes."""
        return self._fixed or self._form.longest

    def feed(self, data: bytes) -> list[TableItem]:  # type: ignore[explicit-override]  # Python 3.12's
        """Return the frames that `data` completed, in wire order; never raises."""
        skipped = self.skipped
        found = super().feed(data)
        if self.skipped == skipped:
            return found
        return [item for item in found if not isinstance(item, TableMessage) or item.data]

    def flush(self) -> list[TableItem]:  # type: ignore[explicit-override]  # Python 3.12's
        """End the input, or a silence: return frames hidden in the pending bytes."""
        self._is_final = True
        found = self.feed(b"") + super().flush()
        self._is_final, self._in_step_at = False, -1
        return found

    def _read_frame(self, buffer: bytes, at: int, base: int) -> TableMessage | CorruptBytes | None:
        """Return the frame that begins at `at`, the reason why none does, or None if it is cut."""
        form, end = self._form, len(buffer)
        if not buffer.startswith(form.sync, at):
            # the last bytes may be the first of the sync bytes
            is_cut = end - at < len(form.sync) and form.sync.startswith(buffer[at:])
            return None if is_cut and not self._is_final else _NO_START

        size = self._size(buffer, at)
        if at + size > end:
            return None
        fault = _LENGTH if size < self._shortest_frame else self._fault(buffer, at, at + size)
        if fault is None and self._compute is None and base + at != self._in_step_at:
            # without checksum the bytes behind the frame decide
            following = buffer[at + size : at + size + len(form.sync)]
            if not form.sync.startswith(following):
                return _ALONE
            if following != form.sync and not self._is_final:
                return None
        return fault or self._message(buffer, at, at + size, base)

    def _size(self, buffer: bytes, at: int) -> int:
        """Return the bytes from `at` that are needed to decide about a frame there."""
        if self._fixed:
            return self._fixed
        if len(buffer) - at < self._head:
            return self._head
        (length,) = self._read_length(buffer, at)
        size = int(length) + self._form.length_adds
        return size if self._shortest_frame <= size <= self._form.longest else self._head

    def _fault(self, buffer: bytes, at: int, stop: int) -> CorruptBytes | None:
        """Return the reason why the bytes from `at` to `stop` are no frame."""
        end_bytes = self._form.end
        if end_bytes and not buffer.endswith(end_bytes, at, stop):
            return _END
        if self._compute is not None:
            checked = stop - self._tail
            sent = int.from_bytes(buffer[checked : checked + self._width], self._order)
            if self._compute(buffer[at + self._first : checked]) != sent:
                return _CHECKSUM
        return None

    def _message(self, buffer: bytes, at: int, stop: int, base: int) -> TableMessage | CorruptBytes:
        """Return the record of a valid frame; without data if the frame has another type."""
        size, selects = stop - at, self._selects
        wanted = selects is None or (
            size >= selects.size and selects.read(buffer, at)[0] == self._expected
        )
        if wanted and size - self._tail < self._reader.size:
            return CorruptBytes(size, f"frame of {size} bytes is too short for the fields")

        self._in_step_at = base + stop
        if not wanted:
            self.skipped += 1
            return TableMessage((), b"", base + stop)
        data = buffer[at:stop]
        return TableMessage(self._read_fields(data, 0), data, base + stop)


def _start_pattern(sync: bytes) -> re.Pattern[bytes]:
    """Return a pattern of the sync bytes, or of their first ones at the end of a buffer."""
    beginnings = (re.escape(sync[:count]) + rb"\Z" for count in range(len(sync) - 1, 0, -1))
    return re.compile(b"|".join((re.escape(sync), *beginnings)))


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
