"""A socket that drops incoming MQTT packets above a size limit, and messages not admitted.

Invariant: a packet above the limit occupies no memory, and a message that is not admitted is
dropped before it is decoded. The class is necessary because paho buffers a whole packet before it
decodes it. An MQTT 5 client can announce a maximum packet size, but some brokers ignore it, and
MQTT 3.1.1 has no such announcement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

_DISCARDED_BYTES = 64 * 1024
"""Largest number of bytes that are discarded in one iteration of the event loop, so that other
tasks can run."""
_DROPPED_AT_ONCE = 16
"""Largest number of packets dropped in one iteration of the event loop. Each packet takes 10 µs."""
_MORE = 0x80
"""Bit of a length byte that is set if another length byte follows."""
_SHORTEST_HEADER, _LONGEST_HEADER = 2, 5
"""Shortest and longest fixed header, bytes: packet type and one to four length bytes (MQTT 5.0,
2.1.4)."""
_TYPE, _PUBLISH, _RETAIN = 0xF0, 0x30, 0x01
"""Bits of the first byte: mask of the packet type, type PUBLISH, and retain flag."""
_TOPIC_LENGTH_BYTES = 2


class PacketLimitSocket:
    """Wrapper of a connected, non-blocking socket.

    Only ``recv`` differs from the wrapped socket. The wrapper reads no bytes beyond the current
    packet, so both sockets are readable at the same time.

    Parameters
    ----------
    wrapped
        A ``socket.socket`` or ``ssl.SSLSocket``.
    longest_bytes
        Largest packet that is passed on, bytes without the fixed header.
    admit
        Function that is called with topic and retain flag of each message within the limit. If it
        returns False, the message is dropped. A dropped message is not acknowledged, so the
        function is only for subscriptions with QoS 0.
    """

    def __init__(
        self,
        wrapped: Any,
        longest_bytes: int,
        admit: Callable[[str, bool], bool] | None = None,
    ) -> None:
        self.oversized = 0
        """Number of packets larger than the limit."""
        self._wrapped, self._longest_bytes, self._admit = wrapped, longest_bytes, admit
        self._header = b""
        """Header of the current packet. It is complete before its first byte is passed on."""
        self._start = b""
        """Bytes that were read after the header in order to find the topic."""
        self._ready = b""
        """Header, and bytes read with it, that were not passed on yet."""
        self._body_bytes = self._excess_bytes = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)

    def recv(self, size: int) -> bytes:
        """Return up to `size` bytes of admitted packets; empty if the peer closed the connection.

        Raises
        ------
        BlockingIOError
            No byte is available yet, or the limit of dropped data per iteration was reached.
        """
        if not self._ready and not self._body_bytes and not self._find_packet():
            return b""
        if self._ready:
            passed, self._ready = self._ready[:size], self._ready[size:]
            return passed
        data: bytes = self._wrapped.recv(min(size, self._body_bytes))
        self._body_bytes -= len(data)
        return data

    def _find_packet(self) -> bool:
        """Read until the start of the next admitted packet; return False if the peer closed."""
        for _ in range(_DROPPED_AT_ONCE):
            if self._excess_bytes and not self._discard():
                return False
            if not self._read_header():
                return False
            length = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(self._header[1:]))
            if length > self._longest_bytes:
                self.oversized += 1
                self._header, self._excess_bytes = b"", length
                continue

            # The topic decides whether a message is admitted. It is at the start of the packet.
            asks = self._admit is not None and self._header[0] & _TYPE == _PUBLISH
            if asks and not self._read_topic(length):
                return False
            header, start = self._header, self._start
            self._header = self._start = b""
            if asks and self._admit is not None:
                topic = start[_TOPIC_LENGTH_BYTES : _topic_end(start)].decode(errors="replace")
                if not self._admit(topic, bool(header[0] & _RETAIN)):
                    self._excess_bytes = length - len(start)
                    continue

            self._ready, self._body_bytes = header + start, length - len(start)
            return True
        raise BlockingIOError

    def _read_header(self) -> bool:
        """Read until the end of the header; return False if the peer closed the connection."""
        while (missing := _SHORTEST_HEADER - len(self._header)) > 0 or self._header[-1] & _MORE:
            if len(self._header) == _LONGEST_HEADER:
                break  # malformed header, which paho reports
            data: bytes = self._wrapped.recv(max(1, missing))
            if not data:
                return False
            self._header += data
        return True

    def _read_topic(self, length: int) -> bool:
        """Read at least until the end of the topic; return False if the peer closed the connection.

        Parameters
        ----------
        length
            Remaining length of the packet. A topic longer than the packet is malformed, and is
            truncated.
        """
        while len(self._start) < min(length, _topic_end(self._start)):
            data: bytes = self._wrapped.recv(length - len(self._start))
            if not data:
                return False
            self._start += data
        return True

    def _discard(self) -> bool:
        """Read the rest of a dropped packet; return False if the peer closed the connection.

        Raises
        ------
        BlockingIOError
            Bytes of the packet remain to be read in a later iteration of the event loop.
        """
        data = self._wrapped.recv(min(self._excess_bytes, _DISCARDED_BYTES))
        self._excess_bytes -= len(data)
        if data and self._excess_bytes:
            raise BlockingIOError
        return bool(data)


def _topic_end(start: bytes) -> int:
    """Return the end of the topic in the body of a PUBLISH packet that begins with `start`."""
    return _TOPIC_LENGTH_BYTES + int.from_bytes(start[:_TOPIC_LENGTH_BYTES], "big")
