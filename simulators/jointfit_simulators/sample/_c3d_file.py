"""C3D files with marker points only: little-endian, points as floats.

Blocks of 512 bytes: the header, the parameters (groups POINT and TRIAL), then the frames, each
point as four 32-bit floats: x, y, z, residual. A missing point has the residual -1 and zeros.
Source: The C3D File Format, User Guide (2008), sections "Header", "Parameters", "3D point data".
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

_BLOCK = 512
"""Bytes per block."""
_KEY = 0x50
"""Second byte of header and parameters in every C3D file."""
_INTEL = 84
"""Processor type: little-endian."""
_FLOATS = -1.0
"""POINT:SCALE; a negative value means floats in the unit of POINT:UNITS."""
_CHARACTERS, _INTEGER, _REAL = -1, 2, 4
"""Types of a parameter."""
_POINT, _TRIAL = 1, 2
"""Numbers of the groups."""
_MISSING = -1.0
"""Residual of a missing point."""


def c3d_bytes(names: Sequence[str], positions: Array, *, rate_hz: float, up: str) -> bytes:
    """Return a C3D file.

    Parameters
    ----------
    names
        Labels of the points.
    positions
        Shape (n, len(names), 3), m, n at most 65535; NaN where a point is missing. Written in mm.
    rate_hz
        Frames per second.
    up
        The upward axis, ``"+Y"`` for example (POINT:Y_SCREEN).
    """
    frames, points = positions.shape[:2]

    # the number of the first data block is part of the parameters, whose length is constant
    parameters = _parameters(names, frames=frames, rate_hz=rate_hz, up=up, data_block=0)
    data_block = 2 + -(-len(parameters) // _BLOCK)
    parameters = _parameters(names, frames=frames, rate_hz=rate_hz, up=up, data_block=data_block)

    header = struct.pack(
        "<BBHHHHHfHHf", 2, _KEY, points, 0, 1, frames, 0, _FLOATS, data_block, 0, rate_hz
    )

    missing = np.isnan(positions[..., :1])
    cells = np.concatenate(
        [np.where(missing, 0.0, positions * 1e3), np.where(missing, _MISSING, 0.0)], axis=-1
    )
    sections = (header, parameters, cells.astype("<f4").tobytes())
    return b"".join(section + bytes(-len(section) % _BLOCK) for section in sections)


def _parameters(
    names: Sequence[str], *, frames: int, rate_hz: float, up: str, data_block: int
) -> bytes:
    width = max(map(len, names))
    labels = "".join(name.ljust(width) for name in names)
    entries = [
        _group(_POINT, "POINT"),
        _group(_TRIAL, "TRIAL"),
        _parameter(_POINT, "USED", _INTEGER, (), struct.pack("<H", len(names))),
        _parameter(_POINT, "FRAMES", _INTEGER, (), struct.pack("<H", frames)),
        _parameter(_POINT, "DATA_START", _INTEGER, (), struct.pack("<H", data_block)),
        _parameter(_POINT, "SCALE", _REAL, (), struct.pack("<f", _FLOATS)),
        _parameter(_POINT, "RATE", _REAL, (), struct.pack("<f", rate_hz)),
        _parameter(_POINT, "UNITS", _CHARACTERS, (2,), b"mm"),
        _parameter(_POINT, "Y_SCREEN", _CHARACTERS, (len(up),), up.encode("ascii")),
        _parameter(_POINT, "LABELS", _CHARACTERS, (width, len(names)), labels.encode("ascii")),
        _parameter(_TRIAL, "ACTUAL_START_FIELD", _INTEGER, (2,), struct.pack("<HH", 1, 0)),
        _parameter(_TRIAL, "ACTUAL_END_FIELD", _INTEGER, (2,), struct.pack("<HH", frames, 0)),
    ]
    body = b"".join(entries) + bytes(2)  # a name of length 0 ends the section
    return bytes([1, _KEY, -(-(len(body) + 4) // _BLOCK), _INTEL]) + body


def _group(number: int, name: str) -> bytes:
    return _entry(name, -number, b"\0")


def _parameter(group: int, name: str, kind: int, shape: tuple[int, ...], data: bytes) -> bytes:
    rest = struct.pack("<bB", kind, len(shape)) + bytes(shape) + data + b"\0"
    return _entry(name, group, rest)


def _entry(name: str, group: int, rest: bytes) -> bytes:
    """Return an entry: lengths, name, offset to the next entry from itself, and `rest`."""
    offset = struct.pack("<H", len(rest) + 2)
    return struct.pack("<bb", len(name), group) + name.encode() + offset + rest
