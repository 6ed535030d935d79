"""Splitting of a byte stream into packets whose header contains their size.

A packet does not correspond to a TCP segment, so it may arrive in several parts. After an invalid
header, the next packet cannot be found. The connection must then be closed, and all further bytes
are corrupt.

Invariant: the result does not depend on the boundaries of the received parts. At most one
incomplete packet is stored, so the memory is limited by the largest size that a protocol accepts.
The time is proportional to the number of bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Callable


class PacketStream:
    """Splits a byte stream into complete packets.

    Parameters
    ----------
    header_bytes : int
        Number of bytes of a header.
    size_of : callable
        Function that returns the size of the packet whose header begins at an index of a buffer,
        including the header. It returns None if the header is invalid.
    """

    def __init__(self, header_bytes: int, size_of: Callable[[bytearray, int], int | None]) -> None:
        self._header_bytes = header_bytes
        self._size_of = size_of
        self._buffer = bytearray()
        self.broken = False
        """Whether a header was invalid. In this case no further packet can be found."""

    def feed(self, data: bytes) -> list[bytes | CorruptBytes]:
        """Return the packets that `data` completes; never raise."""
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
