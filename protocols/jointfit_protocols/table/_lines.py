"""Text lines of a serial device that a table describes, with one sample per line.

    prefix number separator number ... *checksum CR LF

Arduino sketches print such lines. Lines with another prefix are skipped and counted. The optional
checksum has the form of NMEA 0183: ``*`` and two or four hexadecimal digits.

Invariant: the codec converts bytes to messages. It uses no port and no clock, and the boundaries of
the byte strings do not matter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, CUT_OFF, CorruptRun
from jointfit_protocols.table._checksums import Checksum, compile_checksum
from jointfit_protocols.table._messages import TableItem, TableMessage

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

LONGEST_LINE = 1024
"""Largest length of a line, bytes."""
_MARK = b"*"


class LineFormat(NamedTuple):
    """Layout of the lines of a serial device."""

    columns: Mapping[int, int]
    """Column of each slot of the record. The first column has the number 0."""
    separator: bytes = b","
    prefix: bytes = b""
    """Beginning of every line with measurements. The first column follows it."""
    width: int | None = None
    """Required number of columns. None accepts any number that includes all fields."""
    checksum: Checksum | None = None


class LineCodec:
    """Codec that converts byte strings of any size to records; it never raises.

    Parameters
    ----------
    form : LineFormat
        Layout of the lines.
    """

    def __init__(self, form: LineFormat) -> None:
        self._form = form
        self.slots = tuple(sorted(form.columns))
        """Slots of a record, in the order of its numbers."""
        self._columns = [form.columns[slot] for slot in self.slots]
        self._least = max(self._columns, default=-1) + 1
        self._compute = None if form.checksum is None else compile_checksum(form.checksum)
        self._digits = 0 if form.checksum is None else 2 * form.checksum.width
        self._pending = b""
        self._joined = False  # whether the pending line lost its beginning
        self._run = CorruptRun(LONGEST_LINE)
        self.fed = 0
        """Number of bytes fed so far."""
        self.messages = 0
        """Number of lines so far, including lines with another prefix."""
        self.skipped = 0
        """Number of lines with another prefix so far."""
        self.checksum_failures = 0
        """Number of lines with a wrong checksum so far."""

    @property
    def discarded(self) -> int:
        """Number of bytes so far that belong to no message."""
        return self._run.discarded

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete line in the buffer."""
        return len(self._pending)

    @property
    def longest(self) -> int:
        """Largest length of a line, bytes."""
        return LONGEST_LINE

    def feed(self, data: bytes) -> list[TableItem]:
        """Return the lines that `data` completes, in wire order; never raise."""
        found: list[TableItem] = []
        *lines, rest = (self._pending + data).split(b"\n")
        end = self.fed - len(self._pending)
        self.fed += len(data)
        for line in lines:
            end += len(line) + 1
            self._take(line, end, found)
        if len(rest) > LONGEST_LINE:
            self._run.add(len(rest), _ENDLESS, found)
            rest, self._joined = b"", True  # the end of a truncated line is not a line
        self._pending = rest
        return found

    def flush(self) -> list[TableItem]:
        """Discard an incomplete line."""
        found: list[TableItem] = []
        if self._pending:
            self._run.add(len(self._pending), CUT_OFF, found)
        self._pending, self._joined = b"", False
        self._run.end(found)
        return found

    def _take(self, line: bytes, end: int, found: list[TableItem]) -> None:
        """Append the record or the corrupt bytes of `line` (without LF)."""
        joined, self._joined = self._joined, False
        values, reason = (None, _ENDLESS) if joined else self._read(line)
        if values is not None:
            self._run.end(found)
            self.messages += 1
            found.append(TableMessage(values, line + b"\n", end))
        elif reason:
            self._run.add(len(line) + 1, reason, found)
        else:
            self._run.end(found)
            self.messages += 1
            self.skipped += 1

    def _read(self, line: bytes) -> tuple[tuple[float, ...] | None, str]:
        """Return the record of a line, or None with a reason, which is empty for skipped lines."""
        form = self._form
        text = line.rstrip(b"\r")
        if not text or not text.startswith(form.prefix):
            is_text = text.isascii() and text.decode("ascii").isprintable()
            return None, "" if is_text else _NO_TEXT
        if self._compute is not None:
            text, mark, digits = text.rpartition(_MARK)
            if not mark or len(digits) != self._digits or not self._matches(text, digits):
                self.checksum_failures += 1
                return None, CHECKSUM

        cells = text[len(form.prefix) :].split(form.separator or None)
        if len(cells) < self._least or (form.width is not None and len(cells) != form.width):
            return None, f"{len(cells)} columns"
        try:
            values = tuple([float(cells[at]) for at in self._columns])
        except ValueError:
            return None, _NO_NUMBER
        # Python would accept 1_000 as a number.
        return (None, _NO_NUMBER) if b"_" in text else (values, "")

    def _matches(self, text: bytes, digits: bytes) -> bool:
        checksum, compute = self._form.checksum, self._compute
        if checksum is None or compute is None:
            return True
        try:
            return compute(text[checksum.first :]) == int(digits, 16)
        except ValueError:
            return False


def encode_line(form: LineFormat, values: Sequence[float]) -> bytes:
    """Return the line that contains a record; columns without a slot are 0."""
    count = form.width or max(form.columns.values()) + 1
    cells = [b"0"] * count
    for slot, value in zip(sorted(form.columns), values, strict=True):
        text = repr(value) if isinstance(value, int) else f"{value:.9g}"
        cells[form.columns[slot]] = text.encode()
    line = form.prefix + (form.separator or b" ").join(cells)
    if form.checksum is not None:
        total = compile_checksum(form.checksum)(line[form.checksum.first :])
        line += _MARK + f"{total:0{2 * form.checksum.width}X}".encode()
    return line + b"\r\n"


_ENDLESS = "line without end"
_NO_TEXT = "no text"
_NO_NUMBER = "a column is not a number"
