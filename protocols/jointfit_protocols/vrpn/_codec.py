"""Codec of a VRPN byte stream: cookie, messages, and descriptions of senders and types.

A server sends messages by TCP and in UDP datagrams. A datagram contains only complete messages. If
the caller feeds only complete messages of the TCP stream (`whole_messages`), it can feed datagrams
in between. A message has no start pattern and no checksum. After an impossible length, everything
up to the next cookie (the first bytes of a connection) is discarded, and a driver closes the
connection.

Invariant: the codec converts bytes to messages. It uses no socket and no clock, and the boundaries
of the byte strings do not matter. At most one incomplete message is stored, and at most `MAX_IDS`
descriptions of each kind.
"""

from __future__ import annotations

import re
from enum import IntEnum

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vrpn._messages import (
    ACCELERATION,
    HEADER,
    MAX_IDS,
    MAX_MESSAGE,
    MAX_NAME,
    MOTION_LAYOUT,
    NAME_LENGTH,
    PING,
    PONG,
    POS_QUAT,
    POSE_LAYOUT,
    VELOCITY,
    Cookie,
    Disconnect,
    Ping,
    Pong,
    SenderDescription,
    SystemType,
    TrackerMotion,
    TrackerPose,
    TypeDescription,
    UdpChannel,
    VrpnContent,
    VrpnMessage,
)

COOKIE_BYTES = 24
HEADER_BYTES = HEADER.size
_MAGIC = b"vrpn: ver. "
_COOKIE = re.compile(rb"vrpn: ver\. (\d\d)\.(\d\d)  ([0-3])\0.{4}", re.DOTALL)
"""Pattern of a cookie. The reference implementation does not initialize the last four bytes."""
_FIRST = int.from_bytes(_MAGIC[:4], "big")
"""Value of the first bytes of a cookie if they are read as a length field."""
_US = 1_000_000
_POSE_BYTES = HEADER_BYTES + POSE_LAYOUT.size
_RUN = 4096
"""Largest number of discarded bytes in one `CorruptBytes`. Longer runs are reported in parts."""


class _Kind(IntEnum):
    POSE = 1
    VELOCITY = 2
    ACCELERATION = 3
    PING = 4
    PONG = 5


_KINDS = {
    POS_QUAT: _Kind.POSE,
    VELOCITY: _Kind.VELOCITY,
    ACCELERATION: _Kind.ACCELERATION,
    PING: _Kind.PING,
    PONG: _Kind.PONG,
}


class VrpnCodec:
    """Codec for one direction of a connection.

    A cookie starts a new connection, and the descriptions of the last connection are discarded.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._needed = HEADER_BYTES
        """Number of buffered bytes at which the next message can be decoded."""
        self._lost = False
        self._run = 0
        self._kinds: dict[int, _Kind] = {}
        self.senders: dict[int, str] = {}
        """Names of the senders that the peer has described."""
        self.types: dict[int, str] = {}
        """Names of the message types that the peer has described."""
        self.messages = 0
        """Number of messages so far, including cookies."""
        self.discarded = 0
        """Number of bytes so far that belong to no message."""

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete message in the buffer."""
        return len(self._buffer)

    @property
    def lost(self) -> bool:
        """Whether the stream cannot be decoded until the next cookie."""
        return self._lost

    def feed(self, data: bytes) -> list[VrpnContent | CorruptBytes]:
        """Return the messages that `data` completes, in wire order; never raise."""
        buffer = self._buffer
        buffer += data
        if len(buffer) < self._needed:
            return []

        found: list[VrpnContent | CorruptBytes] = []
        at, end = 0, len(buffer)
        unpack, unpack_pose, kinds = HEADER.unpack_from, POSE_LAYOUT.unpack_from, self._kinds
        while True:
            if self._lost:
                at = self._seek_cookie(at, found)
            if end - at < HEADER_BYTES:
                self._needed = HEADER_BYTES
                break
            length, seconds, micros, sender, kind, _ = unpack(buffer, at)
            if length == _FIRST:
                at = self._cookie(at, found)
                continue
            if not HEADER_BYTES <= length <= MAX_MESSAGE:
                self._lost = True
                continue

            size = (length + 7) & ~7
            if end - at < size:
                self._needed = size
                break
            # This case is tested first, because nearly all messages are poses.
            if length == _POSE_BYTES and kinds.get(kind) is _Kind.POSE and micros < _US:
                sensor, x, y, z, qx, qy, qz, qw = unpack_pose(buffer, at + HEADER_BYTES)
                found.append(
                    TrackerPose(seconds * _US + micros, sender, sensor, x, y, z, qx, qy, qz, qw)
                )
                self.messages += 1
            else:
                body = bytes(buffer[at + HEADER_BYTES : at + length])
                content = self._content(seconds, micros, sender, kind, body)
                if isinstance(content, str):
                    self.discarded += size
                    found.append(CorruptBytes(size, content))
                else:
                    self.messages += 1
                    found.append(content)
            at += size

        del buffer[:at]
        return found

    def flush(self) -> list[CorruptBytes]:
        """Discard an incomplete message, because the connection is closed."""
        pending = len(self._buffer) + self._run
        self.discarded += len(self._buffer)
        self._buffer.clear()
        self._needed, self._run = HEADER_BYTES, 0
        return [CorruptBytes(pending, "incomplete message")] if pending else []

    # --- connection ---------------------------------------------------------------------------

    def _seek_cookie(self, at: int, found: list[VrpnContent | CorruptBytes]) -> int:
        """Return the start of the next (possible) cookie, and count the bytes before it."""
        start = self._buffer.find(_MAGIC, at)
        if start >= 0:
            self._lost = False
        else:
            start = max(at, len(self._buffer) - len(_MAGIC) + 1)

        self.discarded += start - at
        self._run += start - at
        while self._run >= _RUN or (self._run and not self._lost):
            part = min(self._run, _RUN)
            found.append(CorruptBytes(part, "no message: lost until the next connection"))
            self._run -= part
        return start

    def _cookie(self, at: int, found: list[VrpnContent | CorruptBytes]) -> int:
        """Append the cookie at `at` to `found`, and return the position after the cookie.

        The descriptions of the previous connection are discarded. If the bytes are no valid cookie,
        one byte is discarded, and the search for a cookie continues.
        """
        match = _COOKIE.fullmatch(self._buffer, at, at + COOKIE_BYTES)
        if match is None:
            self.discarded += 1
            self._run += 1
            self._lost = True
            return at + 1
        self.senders.clear()
        self.types.clear()
        self._kinds.clear()
        self.messages += 1
        found.append(Cookie(int(match[1]), int(match[2]), int(match[3])))
        return at + COOKIE_BYTES

    # --- messages -----------------------------------------------------------------------------

    def _content(  # noqa: PLR0911 - one case per type
        self, seconds: int, micros: int, sender: int, kind: int, body: bytes
    ) -> VrpnContent | str:
        """Return the content of one message, or the reason why it is rejected."""
        if kind < 0:
            return self._system(seconds * _US + micros, sender, kind, body)
        if micros >= _US:
            return "more than 999 999 microseconds"

        time_us = seconds * _US + micros
        match self._kinds.get(kind):
            case _Kind.POSE:
                return "pose whose body does not have 64 bytes"
            case _Kind.VELOCITY | _Kind.ACCELERATION:
                if len(body) != MOTION_LAYOUT.size:
                    return "velocity or acceleration whose body does not have 72 bytes"
                return TrackerMotion(self.types[kind], time_us, sender, *MOTION_LAYOUT.unpack(body))
            case _Kind.PING:
                return Ping(time_us, sender)
            case _Kind.PONG:
                return Pong(time_us, sender)
        return VrpnMessage(time_us, sender, kind, body)

    def _system(self, time_us: int, sender: int, kind: int, body: bytes) -> VrpnContent | str:
        match kind:
            case SystemType.SENDER | SystemType.TYPE:
                return self._description(sender, kind, body)
            case SystemType.UDP:
                if not 0 < sender <= 0xFFFF:  # noqa: PLR2004 - highest port
                    return "no UDP port"
                return UdpChannel(sender, _text(body))
            case SystemType.DISCONNECT:
                return Disconnect()
        return VrpnMessage(time_us, sender, kind, body)

    def _description(self, number: int, kind: int, body: bytes) -> VrpnContent | str:
        if not 0 <= number < MAX_IDS:
            return f"described id outside 0..{MAX_IDS - 1}"
        if len(body) < NAME_LENGTH.size:
            return "description without a name"
        (length,) = NAME_LENGTH.unpack_from(body)
        if length > len(body) - NAME_LENGTH.size or length > MAX_NAME + 1:
            return "name longer than its description"
        name = _text(body[NAME_LENGTH.size : NAME_LENGTH.size + length])

        if kind == SystemType.SENDER:
            self.senders[number] = name
            return SenderDescription(number, name)
        self.types[number] = name
        self._kinds.pop(number, None)
        if name in _KINDS:
            self._kinds[number] = _KINDS[name]
        return TypeDescription(number, name)


def whole_messages(data: bytes) -> int:
    """Return the number of bytes of `data` up to the end of its last complete message or cookie.

    The function decodes no content. If a length is impossible, it returns the size of `data`, so
    that the codec receives all bytes and rejects them.
    """
    at, end = 0, len(data)
    while end - at >= HEADER_BYTES:
        length = int.from_bytes(data[at : at + 4], "big")
        if length == _FIRST:
            size = COOKIE_BYTES
        elif HEADER_BYTES <= length <= MAX_MESSAGE:
            size = (length + 7) & ~7
        else:
            return end
        if end - at < size:
            break
        at += size
    return at


def is_whole(datagram: bytes) -> bool:
    """Return whether a datagram consists of complete messages. A cookie is not a message."""
    at, end = 0, len(datagram)
    while end - at >= HEADER_BYTES:
        length = int.from_bytes(datagram[at : at + 4], "big")
        if not HEADER_BYTES <= length <= MAX_MESSAGE:
            return False
        at += (length + 7) & ~7
    return at == end > 0


def _text(data: bytes) -> str:
    return data[:MAX_NAME].split(b"\0", 1)[0].decode("utf-8", "replace")
