"""Differences between the received bytes and the table in rig.toml that describes them.

Each difference is described in an error message with its remedy.

Invariant: the functions are pure, and return a text for every input.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING

from jointfit_protocols.table import (
    WIDTHS,
    Checksum,
    FieldReader,
    FrameFormat,
    LineFormat,
    compile_checksum,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_protocols.table import ByteOrder

_SHARE = 0.5
"""Smallest share of the sync bytes, or of the lines, that a finding must explain."""
_FEW = 3
"""Smallest number of frames for a finding."""
_PRINTABLE = 0.95
"""Smallest share of printable characters in text."""
_NAMED = 8
"""Largest number of frame types listed in a message."""
_SHOWN = 24
"""Number of bytes displayed in an error message."""


def explain_bytes(data: bytes, wire: FrameFormat | LineFormat) -> str:
    """Return why `data` contain no message of the format `wire`, with the key to change."""
    is_text = sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in data) >= _PRINTABLE * len(data)  # noqa: PLR2004 - ASCII
    if isinstance(wire, LineFormat):
        return _explain_lines(data, wire) if is_text else _NOT_TEXT.format(_hex_text(data))
    if is_text:
        return f"they are text, such as {data[:_SHOWN]!r}: describe them with `text`, not `frame`"
    return _explain_frames(data, wire)


def _explain_lines(data: bytes, wire: LineFormat) -> str:
    lines = [line.rstrip(b"\r") for line in data.split(b"\n")[1:-1] if line.strip()]
    if not lines:
        return "no end of a line found, expected LF: check `baud`"
    example = repr(lines[-1][:60].decode("ascii", "replace"))
    wanted = [line for line in lines if line.startswith(wire.prefix)]
    if not wanted:
        prefix = wire.prefix.decode("ascii", "replace")
        return f"no line begins with {prefix!r}, found {example}: correct `text.prefix`"

    separator = _likely_separator(wanted, wire)
    if separator is not None:
        return f"lines such as {example} have another separator: set `text.separator` = {separator}"
    found = Counter(len(_cells(line, wire)) for line in wanted).most_common(1)[0][0]
    needed = wire.width or max(wire.columns.values()) + 1
    if found < needed or (wire.width is not None and found != needed):
        remedy = "correct `text.columns` and `column` of the fields"
        return f"lines such as {example} have {found} columns, expected {needed}: {remedy}"
    if wire.checksum is not None:
        return f"no line has a valid checksum, found {example}: correct `text.checksum`"
    return f"a column is not a number in lines such as {example}: correct `column` of the fields"


def _likely_separator(lines: Sequence[bytes], wire: LineFormat) -> str | None:
    """Return the separator of most lines; None if a line contains the configured separator."""
    if any(len(_cells(line, wire)) > 1 for line in lines):
        return None
    start = len(wire.prefix)
    for separator in (",", ";", "\t", " "):
        if sum(separator.encode() in line[start:] for line in lines) >= _SHARE * len(lines):
            return repr(separator)
    return None


def _cells(line: bytes, wire: LineFormat) -> list[bytes]:
    return line[len(wire.prefix) :].split(wire.separator or None)


def _explain_frames(data: bytes, wire: FrameFormat) -> str:
    sync = wire.sync.hex(" ").upper()
    starts = [found.start() for found in re.finditer(b"(?=" + re.escape(wire.sync) + b")", data)]
    if len(starts) < _FEW:
        shown = _hex_text(data)
        return f"sync bytes {sync} hardly occur in {shown}: check `baud` and `frame.sync`"

    distances = Counter(after - before for before, after in pairwise(starts))
    spacing, times = distances.most_common(1)[0]
    regular = times >= _SHARE * len(starts)
    frames = [data[a:b] for a, b in pairwise(starts) if b - a == spacing]
    finding = None
    if regular:
        finding = _length_finding(data, starts, spacing, wire) or _end_finding(frames, wire)
    finding = finding or _content_finding(frames, wire)
    if finding is not None:
        return finding

    if regular:
        return (
            f"sync bytes {sync} follow each other after {spacing} bytes, but the frames do not fit "
            "the table: correct the positions of the fields, or `frame.sync` and length"
        )
    return (
        f"sync bytes {sync} have no regular distance, most often {spacing} bytes: correct "
        "`frame.sync` and length"
    )


def _end_finding(frames: Sequence[bytes], wire: FrameFormat) -> str | None:
    """Return the finding that frames of equal length lack their `end`; None if they have it."""
    if sum(frame.endswith(wire.end) for frame in frames) >= _SHARE * len(frames):
        return None
    end = wire.end.hex(" ").upper()
    return f"frames of {len(frames[0])} bytes do not end with {end}: correct `frame.end`"


def _content_finding(frames: Sequence[bytes], wire: FrameFormat) -> str | None:
    """Return the difference in checksum or type of frames of equal length; None without one."""
    valid = 0
    if wire.checksum is not None:
        valid = sum(_is_valid(frame, wire.checksum, wire) for frame in frames)
    if wire.checksum is not None and valid < _SHARE * len(frames):
        usual = _usual_checksums(len(wire.sync)) if len(frames) >= _FEW else ()
        fits = (one for one in usual if all(_is_valid(frame, one, wire) for frame in frames))
        fitting = next(fits, None)
        known = "" if fitting is None else f"; the data fit {_checksum_keys(fitting)}"
        size = len(frames[0])
        return f"no checksum of frames with {size} bytes is valid{known}: correct `frame.checksum`"
    if wire.message is not None:
        read = FieldReader([wire.message[0]])
        values = {int(read.read(frame, 0)[0]) for frame in frames if len(frame) >= read.size}
        if values and wire.message[1] not in values:
            shown = ", ".join(map(str, sorted(values)[:_NAMED]))
            expected = f"expected {wire.message[1]}"
            return f"frames have the type {shown}, {expected}: correct `frame.message.equals`"
    return None


def _length_finding(
    data: bytes, starts: Sequence[int], spacing: int, wire: FrameFormat
) -> str | None:
    """Return the difference between the frame length in table and data; None if they agree."""
    if isinstance(wire.length, int):
        if spacing == wire.length:
            return None
        found = f"sync bytes follow each other after {spacing} bytes, expected {wire.length}"
        return f"{found}: set `frame.length` = {spacing}"

    read = FieldReader([wire.length])
    whole = [at for at in starts if at + read.size <= len(data)]
    lengths = Counter(int(read.read(data, at)[0]) for at in whole)
    value, count = lengths.most_common(1)[0]
    if count < _SHARE * len(whole) or value + wire.length_adds == spacing:
        return None
    remedy = f"set `frame.length_field.adds` = {spacing - value}"
    return f"the length field of frames of {spacing} bytes contains {value}: {remedy}"


def _is_valid(frame: bytes, checksum: Checksum, wire: FrameFormat) -> bool:
    """Return whether the checksum of a frame, before its `end` bytes, is correct."""
    stop = len(frame) - len(wire.end)
    checked = stop - checksum.width
    sent = int.from_bytes(frame[checked:stop], checksum.byte_order)
    return compile_checksum(checksum)(frame[checksum.first : checked]) == sent


def _usual_checksums(sync: int) -> Iterator[Checksum]:
    """Yield checksums that many devices use, for frames that begin with `sync` sync bytes."""
    for first in dict.fromkeys((0, sync, 1, 2, 3)):
        for kind, width in WIDTHS.items():
            orders: tuple[ByteOrder, ...] = ("little", "big") if width > 1 else ("little",)
            for order in orders:
                base = Checksum(kind, first, order)
                yield base
                if kind == "sum8":
                    yield base._replace(init=0xFF, xor_out=0xFF)
                    yield base._replace(xor_out=0xFF)
                if kind == "fletcher16":
                    yield base._replace(modulus=255)
                if kind == "crc16":
                    yield base._replace(init=0xFFFF)
                    yield base._replace(polynomial=0x8005, init=0xFFFF, reflected=True)
                    yield base._replace(polynomial=0x8005, reflected=True)
                    yield base._replace(reflected=True)


def _checksum_keys(checksum: Checksum) -> str:
    """Return the keys of a checksum whose values differ from the defaults."""
    plain = Checksum(checksum.kind)
    keys = [f'kind = "{checksum.kind}"']
    for name, value in checksum._asdict().items():
        if name == "kind" or value == getattr(plain, name):
            continue
        shown = f'"{value}"' if isinstance(value, str) else f"0x{value:X}"
        shown = str(value).lower() if isinstance(value, bool) else shown
        keys.append(f"{name} = {value if name == 'first' else shown}")
    return ", ".join(keys)


def _hex_text(data: bytes) -> str:
    return data[:_SHOWN].hex(" ").upper()


_NOT_TEXT = "they are not text, found {}: check `baud`, or describe them with `frame`, not `text`"
