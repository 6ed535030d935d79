"""Decoder of NatNet FRAMEOFDATA in every supported bitstream.

Invariant: a frame is accepted only if its end tag is exactly at the end of the datagram.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet._cursor import BREAKS, Cursor
from jointfit_protocols.natnet._frame import SIZED, TICKED, is_supported, read_frame
from jointfit_protocols.natnet._frame_2x import read_frame_2x

if TYPE_CHECKING:
    from jointfit_protocols.natnet._frame import FrameOfData, Version


def decode_frame(datagram: bytes, version: Version) -> FrameOfData | CorruptBytes:
    """Return the frame in a complete FRAMEOFDATA datagram, including its header; never raise."""
    if not is_supported(version):
        return CorruptBytes(
            len(datagram), f"NatNet bitstream {version[0]}.{version[1]} is not supported"
        )
    cursor = Cursor(datagram, 4)
    try:
        if version < TICKED:
            return read_frame_2x(cursor, version)
        return read_frame(cursor, version >= SIZED)
    except BREAKS as problem:
        return CorruptBytes(len(datagram), f"frame: {problem}")
