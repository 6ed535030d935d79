"""C3D files with marker points and events: little-endian, points as floats.

The file consists of blocks of 512 bytes: the header, the parameters (groups POINT, TRIAL, EVENT and
JOINTFIT), and the frames. Each point of a frame is four 32-bit floats: x, y, z, residual. A missing
point has the residual -1 and the coordinates 0. Source: The C3D File Format, User Guide (2008),
sections "Header", "Parameters", "3D point data"; the parameters of the group EVENT follow files
written by Vicon programs.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array

_BLOCK = 512
"""Bytes per block."""
_KEY = 0x50
"""Second byte of header and parameters in every C3D file."""
_INTEL = 84
"""Code of the processor type Intel, whose numbers are little-endian."""
_FLOATS = -1.0
"""Value of POINT:SCALE. A negative value means that the points are floats in POINT:UNITS."""
_CHARACTERS, _INTEGER, _REAL = -1, 2, 4
"""Numbers of the parameter types."""
_POINT, _TRIAL, _EVENT, _OWN = 1, 2, 3, 4
"""Numbers of the parameter groups."""
_MISSING = -1.0
"""Residual of a missing point."""
_MOST_WORD = 0xFFFF
"""Largest 16-bit number. Larger frame numbers can only be stored in the group TRIAL."""
MOST_ITEMS = 255
"""Largest number of entries of a list parameter, which limits the events and the labels per
list."""
_MOST_BYTES = 255
"""Largest size of a text in a list parameter, bytes."""
_MOST_BLOCKS = 255
"""Largest number of blocks of the parameter section."""


class C3dEvent(NamedTuple):
    """An event of a trial."""

    t_s: float
    """Time, s; frame 1 is at 0 s."""
    label: str
    """Kind of event, for example ``Foot Strike``."""
    context: str = ""
    """Side or subject to which the event belongs."""
    text: str = ""


def c3d_bytes(
    names: Sequence[str],
    positions: Array,
    *,
    rate_hz: float,
    up: str,
    first_frame: int = 1,
    events: Sequence[C3dEvent] = (),
    own_texts: Mapping[str, str] | None = None,
) -> bytes:
    """Return a C3D file.

    Parameters
    ----------
    names
        Labels of the points.
    positions
        Shape (n, len(names), 3), m; NaN where a point is missing. The file contains mm.
    rate_hz
        Frames per second.
    up
        Upward axis, for example ``"+Y"`` (POINT:Y_SCREEN).
    first_frame
        Number of the first frame, 1 to 65535.
    events
        Events, at most `MOST_ITEMS`.
    own_texts
        Texts that are stored as parameters of the group JOINTFIT.

    Raises
    ------
    ValueError
        The labels, events and texts need more space than the format provides.
    """
    frames, points = positions.shape[:2]
    last_frame = first_frame + frames - 1

    # The parameters contain the number of the first data block, which follows from their length.
    # The length is computed first, because it does not depend on this number.
    entries = _entries(names, frames, first_frame, rate_hz, up)
    entries += _event_entries(events)
    if own_texts:
        entries.append(_group(_OWN, "JOINTFIT"))
        entries += [_texts(_OWN, name, [text]) for name, text in own_texts.items()]
    start = _parameter(_POINT, "DATA_START", _INTEGER, (), struct.pack("<H", 0))
    size = 4 + sum(map(len, entries)) + len(start) + 2
    blocks = -(-size // _BLOCK)
    if blocks > _MOST_BLOCKS:
        raise ValueError(
            f"C3D: labels and events take {size} bytes, at most {_MOST_BLOCKS * _BLOCK} fit:"
            " shorten the names, or choose another format"
        )

    data_block = 2 + blocks
    start = _parameter(_POINT, "DATA_START", _INTEGER, (), struct.pack("<H", data_block))
    # An entry with a name of length 0 ends the section.
    parameters = bytes([1, _KEY, blocks, _INTEL]) + b"".join([*entries, start]) + bytes(2)

    header = struct.pack(
        "<BBHHHHHfHHf", 2, _KEY, points, 0, first_frame, min(last_frame, _MOST_WORD), 0, _FLOATS,
        data_block, 0, rate_hz,
    )  # fmt: skip
    missing = np.isnan(positions).any(axis=-1, keepdims=True)
    cells = np.concatenate(
        [np.where(missing, 0.0, positions * 1e3), np.where(missing, _MISSING, 0.0)], axis=-1
    )
    data = cells.astype("<f4").tobytes()
    sections = [header, parameters]
    if last_frame <= _MOST_WORD:
        sections.append(data)
        data = b""
    # Programs that use only the header read a trial with frame numbers above `_MOST_WORD` up to the
    # end of the file. The file of such a trial therefore has no padding.
    return b"".join(section + bytes(-len(section) % _BLOCK) for section in sections) + data


def _entries(
    names: Sequence[str], frames: int, first_frame: int, rate_hz: float, up: str
) -> list[bytes]:
    last = first_frame + frames - 1
    entries = [
        _group(_POINT, "POINT"),
        _group(_TRIAL, "TRIAL"),
        _group(_EVENT, "EVENT"),
        _parameter(_POINT, "USED", _INTEGER, (), struct.pack("<H", len(names))),
        _parameter(_POINT, "FRAMES", _INTEGER, (), struct.pack("<H", min(frames, _MOST_WORD))),
        _parameter(_POINT, "SCALE", _REAL, (), struct.pack("<f", _FLOATS)),
        _parameter(_POINT, "RATE", _REAL, (), struct.pack("<f", rate_hz)),
        _parameter(_POINT, "UNITS", _CHARACTERS, (2,), b"mm"),
        _parameter(_POINT, "Y_SCREEN", _CHARACTERS, (len(up),), up.encode("ascii")),
        _parameter(_TRIAL, "ACTUAL_START_FIELD", _INTEGER, (2,), _words(first_frame)),
        _parameter(_TRIAL, "ACTUAL_END_FIELD", _INTEGER, (2,), _words(last)),
    ]
    for k in range(0, len(names), MOST_ITEMS):
        suffix = str(k // MOST_ITEMS + 1) if k else ""
        entries.append(_texts(_POINT, f"LABELS{suffix}", names[k : k + MOST_ITEMS]))
    return entries


def _event_entries(events: Sequence[C3dEvent]) -> list[bytes]:
    count = len(events)
    entries = [_parameter(_EVENT, "USED", _INTEGER, (), struct.pack("<H", count))]
    if events:
        # Times are stored as minutes and seconds, because a 32-bit float of seconds loses
        # milliseconds after an hour.
        times = [part for event in events for part in divmod(event.t_s, 60.0)]
        entries += [
            _parameter(_EVENT, "TIMES", _REAL, (2, count), struct.pack(f"<{2 * count}f", *times)),
            _texts(_EVENT, "LABELS", [event.label for event in events]),
            _texts(_EVENT, "CONTEXTS", [event.context for event in events]),
            _texts(_EVENT, "DESCRIPTIONS", [event.text for event in events]),
        ]
    return entries


def _words(number: int) -> bytes:
    """Return a frame number as its low and its high 16 bits."""
    return struct.pack("<HH", number & _MOST_WORD, number >> 16)


def _texts(group: int, name: str, texts: Sequence[str]) -> bytes:
    """Return a list of texts, padded with blanks to one width; longer texts are truncated."""
    cut = [text.encode()[:_MOST_BYTES].decode(errors="ignore").encode() for text in texts]
    width = max(1, *map(len, cut))
    data = b"".join(text.ljust(width) for text in cut)
    return _parameter(group, name, _CHARACTERS, (width, len(texts)), data)


def _group(number: int, name: str) -> bytes:
    return _entry(name, -number, b"\0")


def _parameter(group: int, name: str, kind: int, shape: tuple[int, ...], data: bytes) -> bytes:
    rest = struct.pack("<bB", kind, len(shape)) + bytes(shape) + data + b"\0"
    return _entry(name, group, rest)


def _entry(name: str, group: int, rest: bytes) -> bytes:
    """Return an entry: length of the name, group, name, offset of the next entry, and `rest`."""
    offset = struct.pack("<H", len(rest) + 2)
    return struct.pack("<bb", len(name), group) + name.encode() + offset + rest
