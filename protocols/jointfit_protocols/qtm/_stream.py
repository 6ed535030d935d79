"""Packets of a QTM connection over TCP.

A packet is not a TCP segment: it arrives in any pieces. After a size that no packet can have, the
next packet cannot be found; the connection must then be closed, and all further bytes are corrupt.

Invariant: the result does not depend on the pieces. At most one incomplete packet is stored, so
memory is bounded by `LARGEST_PACKET`; time is linear in the bytes.
"""

from __future__ import annotations

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.qtm._messages import HEADER, LARGEST_PACKET


class QtmStream:
    """Splits a byte stream into whole packets."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.broken = False
        """Whether a size was invalid, so that no further packet can be found."""

    def feed(self, data: bytes) -> list[bytes | CorruptBytes]:
        """Return the packets that `data` completes; never raises."""
        if self.broken:
            return [CorruptBytes(len(data), "after an invalid packet size")] if data else []

        buffer = self._buffer
        buffer += data
        found: list[bytes | CorruptBytes] = []
        at = 0
        while len(buffer) - at >= HEADER.size:
            size, _ = HEADER.unpack_from(buffer, at)
            if not HEADER.size <= size <= LARGEST_PACKET:
                self.broken = True
                rest = len(buffer) - at
                found.append(CorruptBytes(rest, f"packet size {size}: the stream is unreadable"))
                at = len(buffer)
                break
            if len(buffer) - at < size:
                break
            found.append(bytes(buffer[at : at + size]))
            at += size
        del buffer[:at]
        return found

    def flush(self) -> list[CorruptBytes]:
        """Discard an incomplete packet at the end of the stream."""
        rest = len(self._buffer)
        self._buffer.clear()
        return [CorruptBytes(rest, "incomplete packet")] if rest else []
