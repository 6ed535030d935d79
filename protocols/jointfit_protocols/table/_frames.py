"""Binary frames of a serial device that a table describes.

     0       sync                                          length - end - checksum
    | sync | ... length, type, fields at fixed offsets ... | checksum | end |

The length is fixed, or is a field of the frame plus a constant. The checksum includes all bytes
from a given byte up to the checksum itself. A type field identifies the frames with measurements.
Other valid frames are skipped and counted.

Without a checksum, a frame is accepted only if it directly follows the previous frame, or if the
start of another frame directly follows it. Otherwise, sync bytes inside a frame would be mistaken
for the start of a frame.

Invariant: the codec converts bytes to messages. It uses no port and no clock, and the boundaries of
the byte strings do not matter.
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
"""Largest size of a frame, bytes. It bounds the wait after a corrupt length."""


class FrameFormat(NamedTuple):
    """Layout of the frames of a serial device."""

    sync: bytes
    """Bytes with which every frame begins."""
    fields: Mapping[int, TableField]
    """Position of each slot of the record."""
    length: int | TableField
    """Length of a frame, bytes, or the field that contains the length."""
    length_adds: int = 0
    """Difference between the length of a frame and the value of its length field, bytes."""
    longest: int = LONGEST_FRAME
    """Largest size of a frame with a length field, bytes."""
    checksum: Checksum | None = None
    end: bytes = b""
    """Bytes with which every frame ends."""
    message: tuple[TableField, int] | None = None
    """Type field and its value in frames with measurements. None means that all frames contain
    measurements."""


_NO_START = CorruptBytes(1, NO_START)
_CHECKSUM = CorruptBytes(1, CHECKSUM)
_LENGTH = CorruptBytes(1, "length outside the format")
_END = CorruptBytes(1, "no end bytes")
_ALONE = CorruptBytes(1, "no frame follows, and frames have no checksum")


class FrameCodec(ResynchronizingCodec[TableMessage]):
    """Codec that converts byte strings of any size to records; it never raises.

    A run of bytes without a frame becomes one `CorruptBytes`. `feed` returns only frames with
    measurements.

    Parameters
    ----------
    form : FrameFormat
        Layout of the frames.
    """

    def __init__(self, form: FrameFormat) -> None:
        self._form = form
        self.slots = tuple(sorted(form.fields))
        """Slots of a record, in the order of its numbers."""
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
        """Number of valid frames without measurements so far."""

    @property
    def longest(self) -> int:
        """Largest size of a frame, bytes."""
        return self._fixed or self._form.longest

    def feed(self, data: bytes) -> list[TableItem]:  # type: ignore[explicit-override]  # typing.override needs Python 3.12
        """Return the frames that `data` completes, in wire order; never raise."""
        skipped = self.skipped
        found = super().feed(data)
        if self.skipped == skipped:
            return found
        return [item for item in found if not isinstance(item, TableMessage) or item.data]

    def flush(self) -> list[TableItem]:  # type: ignore[explicit-override]  # typing.override needs Python 3.12
        """Discard an incomplete frame; return frames that the other pending bytes contain."""
        self._is_final = True
        found = self.feed(b"") + super().flush()
        self._is_final, self._in_step_at = False, -1
        return found

    def _read_frame(self, buffer: bytes, at: int, base: int) -> TableMessage | CorruptBytes | None:
        """Return the frame at `at`, the reason why there is none, or None if it is incomplete."""
        form, end = self._form, len(buffer)
        if not buffer.startswith(form.sync, at):
            # The last bytes may be the beginning of the sync bytes.
            is_cut = end - at < len(form.sync) and form.sync.startswith(buffer[at:])
            return None if is_cut and not self._is_final else _NO_START

        size = self._size(buffer, at)
        if at + size > end:
            return None
        fault = _LENGTH if size < self._shortest_frame else self._fault(buffer, at, at + size)
        if fault is None and self._compute is None and base + at != self._in_step_at:
            # Without a checksum, the bytes after the frame decide whether it is valid.
            following = buffer[at + size : at + size + len(form.sync)]
            if not form.sync.startswith(following):
                return _ALONE
            if following != form.sync and not self._is_final:
                return None
        return fault or self._message(buffer, at, at + size, base)

    def _size(self, buffer: bytes, at: int) -> int:
        """Return the number of bytes from `at` on that are needed to decide about a frame there."""
        if self._fixed:
            return self._fixed
        if len(buffer) - at < self._head:
            return self._head
        (length,) = self._read_length(buffer, at)
        size = int(length) + self._form.length_adds
        return size if self._shortest_frame <= size <= self._form.longest else self._head

    def _fault(self, buffer: bytes, at: int, stop: int) -> CorruptBytes | None:
        """Return the reason why the bytes from `at` to `stop` form no frame; None if they do."""
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
        """Return the record of a valid frame. It has no data if the frame has no measurements."""
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
    """Return a pattern for the sync bytes, or for their beginning at the end of a buffer."""
    beginnings = (re.escape(sync[:count]) + rb"\Z" for count in range(len(sync) - 1, 0, -1))
    return re.compile(b"|".join((re.escape(sync), *beginnings)))


def encode_frame(form: FrameFormat, values: Sequence[float], size: int | None = None) -> bytes:
    """Return the frame that contains a record.

    Parameters
    ----------
    form : FrameFormat
        Layout of the frame.
    values : sequence of float
        Record with the numbers as sent, in the order of its slots.
    size : int, optional
        Size of the frame, bytes. By default, it is the fixed length, or the shortest possible
        length.

    Raises
    ------
    struct.error, OverflowError
        A number does not fit into its field.
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
