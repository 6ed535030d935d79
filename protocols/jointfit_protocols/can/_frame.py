"""CAN frames as records of fixed size, which form the data of a CAN chunk.

The decoder of a driver with ``wire = "can"`` receives such chunks. A record has 24 bytes and
contains the stamp of its frame. A chunk with many frames therefore contains all stamps, and a
recording of chunks can be replayed exactly.

     0        8          12      13     14    16         24
    | t_ns i64 | id u32   | flags | size | zero | data[8] |   little-endian

    flags: 1 extended (29-bit), 2 remote request, 4 error frame

Error frames have the layout of Linux (linux/can/error.h), in which the identifier is a set of error
classes. For notes of the host, this project uses two classes that Linux does not use; see
`host_dropped` and `host_corrupt`.

Invariant: unpacking never raises an exception. A record that is not a CAN frame becomes
`CorruptBytes`.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterable

RECORD_BYTES = 24
STANDARD_MAX = 0x7FF
EXTENDED_MAX = 0x1FFF_FFFF
HOST_DROPPED = 1 << 28
"""Error class of this project: the host lost frames. The data are the number of these frames, u64
little-endian."""
HOST_CORRUPT = 1 << 27
"""Error class of this project: bytes on an adapter's line formed no frame. The data are the number
of these bytes, u64 little-endian."""

_RECORD = struct.Struct("<qIBBxx8s")
_COUNT = struct.Struct("<Q")
_EXTENDED, _REMOTE, _ERROR = 1, 2, 4
_FLAGS = _EXTENDED | _REMOTE | _ERROR


class CanFrame(NamedTuple):
    """One classic CAN frame."""

    t_ns: int
    """Host CLOCK_MONOTONIC at the start of the frame, ns, as accurately as it is known."""
    can_id: int
    """Identifier of the frame. In an error frame, it contains the error classes."""
    data: bytes
    """Data bytes, at most 8."""
    extended: bool = False
    """Whether the identifier has 29 bits."""
    error: bool = False
    """Whether this is an error frame of the controller or a note of the host, not a frame on the
    bus."""
    remote: bool = False
    """Whether this is a remote request, which has no data."""


def pack_frames(frames: Iterable[CanFrame]) -> bytes:
    """Return the records of `frames`, 24 bytes each.

    Raises
    ------
    ValueError
        A frame has more than 8 bytes of data.
    """
    pack = _RECORD.pack
    records = []

    for t_ns, can_id, data, extended, error, remote in frames:
        size = len(data)
        if size > 8:  # noqa: PLR2004 - classic CAN
            raise ValueError(f"a classic CAN frame holds at most 8 bytes, not {size}")
        flags = extended | remote << 1 | error << 2
        records.append(pack(t_ns, can_id, flags, size, data))  # struct pads data with zeros
    return b"".join(records)


def unpack_frames(data: bytes) -> list[CanFrame | CorruptBytes]:
    """Return the frames that the records in `data` contain; any bytes are accepted.

    A record with a size above 8, an unknown flag, or an identifier out of range becomes 24 corrupt
    bytes, and unpacking continues with the next record. An incomplete last record is corrupt as
    well, because chunks contain only complete records.
    """
    found: list[CanFrame | CorruptBytes] = []
    whole = len(data) - len(data) % RECORD_BYTES

    for t_ns, can_id, flags, size, body in _RECORD.iter_unpack(
        data if whole == len(data) else data[:whole]
    ):
        if size > 8 or flags > _FLAGS:  # noqa: PLR2004 - classic CAN
            found.append(CorruptBytes(RECORD_BYTES, "no CAN record"))
        elif not flags and can_id <= STANDARD_MAX:  # the usual case
            found.append(CanFrame(t_ns, can_id, body[:size]))
        elif can_id > (EXTENDED_MAX if flags & (_EXTENDED | _ERROR) else STANDARD_MAX):
            found.append(CorruptBytes(RECORD_BYTES, "CAN identifier out of range"))
        else:
            found.append(
                CanFrame(
                    t_ns,
                    can_id,
                    body[:size],
                    bool(flags & _EXTENDED),
                    bool(flags & _ERROR),
                    bool(flags & _REMOTE),
                )
            )

    if whole != len(data):
        found.append(CorruptBytes(len(data) - whole, "incomplete CAN record"))
    return found


def host_dropped(t_ns: int, count: int) -> CanFrame:
    """Return the note that the host lost `count` frames before `t_ns` (receive queue full)."""
    return CanFrame(t_ns, HOST_DROPPED, _COUNT.pack(count), error=True)


def host_corrupt(t_ns: int, count: int) -> CanFrame:
    """Return the note that `count` bytes on an adapter's line formed no frame."""
    return CanFrame(t_ns, HOST_CORRUPT, _COUNT.pack(count), error=True)


def host_count(frame: CanFrame) -> int:
    """Return the number in a note of `host_dropped` or `host_corrupt`; 0 if there is none."""
    return int(_COUNT.unpack(frame.data)[0]) if len(frame.data) == _COUNT.size else 0


def frame_bits(size: int, extended: bool) -> int:
    """Return the length of a frame on the bus, bits, without the stuff bits.

    The length is 47 + 8 n with an 11-bit identifier and 67 + 8 n with a 29-bit identifier,
    including the interframe space. The number of stuff bits depends on the content.
    """
    return (67 if extended else 47) + 8 * size
