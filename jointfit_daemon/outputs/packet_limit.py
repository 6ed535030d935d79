"""A socket that drops incoming MQTT packets over a size limit.

Invariant: a packet over the limit costs time, no memory. paho stores a packet whole before it
decodes it, and asks the kernel for all of it at once. MQTT 5 lets a client announce a maximum
packet size; MQTT 3.1.1 does not, and not every broker respects the announcement.
"""

from __future__ import annotations

from typing import Any

_DISCARDED_BYTES = 64 * 1024
"""Read and discarded in one turn of the event loop: other tasks run in between."""
_MORE = 0x80
"""Bit of a length byte: another one follows."""
_SHORTEST_HEADER, _LONGEST_HEADER = 2, 5
"""Bytes: packet type and up to four bytes of remaining length (MQTT 5.0, section 2.1.4)."""


class PacketLimitSocket:
    """Wraps a connected, non-blocking socket.

    Everything but ``recv`` is the socket's own. Bytes are not buffered beyond a packet's header,
    so the readiness of the socket stays the readiness of this object.

    Parameters
    ----------
    wrapped
        A ``socket.socket`` or ``ssl.SSLSocket``.
    longest_bytes
        Greatest remaining length of a packet that is passed on.
    """

    def __init__(self, wrapped: Any, longest_bytes: int) -> None:
        self.dropped = 0
        """Packets that were over the limit."""
        self._wrapped, self._longest_bytes = wrapped, longest_bytes
        self._header = b""
        """Of the packet being read; complete before any of it is passed on."""
        self._ready = b""
        """What is left of a complete header."""
        self._body_bytes = self._excess_bytes = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)

    def recv(self, size: int) -> bytes:
        """Return up to `size` bytes of packets within the limit; empty: the peer closed.

        Raises
        ------
        BlockingIOError
            Nothing to pass on yet.
        """
        within_packet = self._ready or self._body_bytes or self._excess_bytes
        if not within_packet and not self._read_header():
            return b""
        if self._excess_bytes:
            return self._discard()
        if self._ready:
            passed, self._ready = self._ready[:size], self._ready[size:]
            return passed
        data: bytes = self._wrapped.recv(min(size, self._body_bytes))
        self._body_bytes -= len(data)
        return data

    def _read_header(self) -> bool:
        """Read up to the end of the next header; return False if the peer closed."""
        while len(self._header) < _SHORTEST_HEADER or self._header[-1] & _MORE:
            if len(self._header) == _LONGEST_HEADER:
                break  # malformed: paho reports it
            byte: bytes = self._wrapped.recv(1)
            if not byte:
                return False
            self._header += byte

        header, self._header = self._header, b""
        length = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(header[1:]))
        if length > self._longest_bytes:
            self.dropped += 1
            self._excess_bytes = length
        else:
            self._ready, self._body_bytes = header, length
        return True

    def _discard(self) -> bytes:
        data = self._wrapped.recv(min(self._excess_bytes, _DISCARDED_BYTES))
        if not data:
            return b""
        self._excess_bytes -= len(data)
        raise BlockingIOError
