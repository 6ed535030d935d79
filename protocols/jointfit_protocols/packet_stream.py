"""Splitting of a byte stream into packets whose header contains their size.

A packet is not a TCP segment: it arrives in any pieces. After a header that no packet can have, the
next packet cannot be found; the connection must then be closed, and all further bytes are corrupt.

Invariant: the result does not depend on the pieces. At most one incomplete packet is stored, so
memory is bounded by the largest size that a protocol accepts; time is linear in the bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Callable


class PacketStream:
    """Splits a byte stream into whole packets.

    Parameters
    ----------
    header_bytes : int
        Bytes of a header.
    size_of : callable
        Returns the size of the packet whose header begins at a place of a buffer, header included;
        None if no packet has this header.
    """

    def __init__(self, header_bytes: int, size_of: Callable[[bytearray, int], int | None]) -> None:
        self._header_bytes = header_bytes
        self._size_of = size_of
        self._buffer = bytearray()
        self.broken = False
        """Whether a header was invalid, so that no further packet can be found."""

    def feed(self, data: bytes) -> list[bytes | CorruptBytes]:
        """Return the packets that `data` completes; never raises."""
        if self.broken:
            return [CorruptBytes(len(data), "after an invalid packet header")] if data else []

        buffer = self._buffer
        buffer += data
        found: list[bytes | CorruptBytes] = []
        at = 0
        while len(buffer) - at >= self._header_bytes:
            size = self._size_of(buffer, at)
            if size is None:
                self.broken = True
                found.append(CorruptBytes(len(buffer) - at, "invalid packet header"))
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
