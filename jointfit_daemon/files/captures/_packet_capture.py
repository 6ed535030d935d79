"""Reader of UDP datagrams, TCP segments and CAN frames in pcapng and pcap files.

A truncated file yields the packets before the cut.

The reader supports little- and big-endian files, several sections and interfaces, and microsecond
to nanosecond time stamps. It supports Ethernet (with VLAN tags), Linux cooked, loopback, raw IP and
SocketCAN links, and IPv4 and IPv6 with reassembly of fragments. Everything else in the file is
skipped. Time stamps are returned as in the file, in ns since 1970. A packet without time stamp has
the time stamp of the packet before it.

Source: draft-ietf-opsawg-pcapng; draft-ietf-opsawg-pcap; RFC 791; RFC 8200; RFC 9293.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
PCAP_MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""Byte order (of `struct`), and nanoseconds per unit of the fraction of a second, by the first four
bytes of a pcap file."""

_SECTION, _INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _PACKET = 0x0A0D0D0A, 1, 2, 3, 6
_LITTLE_MAGIC = b"\x4d\x3c\x2b\x1a"
_RESOLUTION, _OFFSET = 9, 14  # numbers of the options if_tsresol, if_tsoffset
_LINK_HEADS = {
    0: (4, None),
    108: (4, None),
    101: (0, None),
    228: (0, None),
    229: (0, None),
    113: (16, 14),
    276: (20, 0),
}
"""Number of bytes before the IP header and offset of the EtherType in these bytes, by link type.
The offset is None if the link has no EtherType."""
_ETHERNET = 1
_IP, _VLAN = (b"\x08\x00", b"\x86\xdd"), (0x8100, 0x88A8)
_TCP, _UDP = 6, 17
_IPV4_HEAD, _IPV6_HEAD = 20, 40
_HOP_OPTIONS, _ROUTING, _FRAGMENT, _TARGET_OPTIONS = 0, 43, 44, 60
_EXTENSIONS = frozenset((_HOP_OPTIONS, _ROUTING, _FRAGMENT, _TARGET_OPTIONS))
"""Extension headers of IPv6, between the IPv6 header and the header of the segment."""
_UDP_HEAD = struct.Struct(">HHHH")
_TCP_HEAD = struct.Struct(">HHIIBB6x")
_SYN = 0x02
_CAN_LINK = 227
_CAN_COOKED = {113: 16, 276: 20}
"""Number of bytes before a CAN frame, by type of cooked link. A cooked link marks CAN frames by the
protocol 0x000C."""
_CAN_PROTOCOL = b"\x00\x0c"
_CAN_HEAD = struct.Struct(">IB3x")
_CAN_EXTENDED, _CAN_REMOTE, _CAN_ERROR = 1 << 31, 1 << 30, 1 << 29
_MOST_CAN_BYTES = 8
_BLOCK_EDGES, _INTERFACE_HEAD, _PACKET_HEAD, _OFFSET_BYTES = 12, 8, 20, 8
_PCAP_HEAD = 24
_MAX_PENDING = 64
"""Largest number of datagrams under reassembly at once."""


class UdpPacket(NamedTuple):
    """One UDP datagram of a capture."""

    t_ns: int
    source_port: int
    target_port: int
    payload: bytes


class TcpSegment(NamedTuple):
    """One TCP segment of a capture."""

    t_ns: int
    source: tuple[bytes, int]
    """Address and port of the sender."""
    target: tuple[bytes, int]
    sequence: int
    """Number of the first byte of the payload."""
    begins: bool
    """Whether the segment begins a connection (flag SYN)."""
    payload: bytes


class CanPacket(NamedTuple):
    """One classic CAN frame of a capture."""

    t_ns: int
    number: int
    data: bytes
    extended: bool
    remote: bool
    error: bool


def read_can(data: bytes) -> Iterator[CanPacket]:
    """Yield the classic CAN frames of a pcapng or pcap file in file order."""
    for t_ns, link, frame in _read_frames(data):
        at = 0 if link == _CAN_LINK else _CAN_COOKED.get(link)
        if at and frame[_LINK_HEADS[link][1] or 0 :][:2] != _CAN_PROTOCOL:
            at = None
        if at is None or len(frame) < at + _CAN_HEAD.size:
            continue
        word, size = _CAN_HEAD.unpack_from(frame, at)
        body = frame[at + _CAN_HEAD.size :]
        if not size <= min(len(body), _MOST_CAN_BYTES):
            continue  # cut off, or CAN FD
        error, remote = bool(word & _CAN_ERROR), bool(word & _CAN_REMOTE)
        extended = bool(word & _CAN_EXTENDED) and not error
        number = word & (0x1FFF_FFFF if extended or error else 0x7FF)
        yield CanPacket(t_ns, number, b"" if remote else body[:size], extended, remote, error)


def read_packets(data: bytes) -> Iterator[UdpPacket | TcpSegment]:
    """Yield the UDP datagrams and TCP segments of a pcapng or pcap file in file order."""
    fragments = _Fragments()
    for t_ns, link, frame in _read_frames(data):
        at = _ip_offset(frame, link)
        packet = None if at is None else _ip_packet(frame[at:])
        segment = None if packet is None else fragments.segment(packet)
        if packet is None or segment is None:
            continue
        if packet.protocol == _TCP:
            found = _tcp_segment(t_ns, packet.addresses, segment)
            if found is not None:
                yield found
        elif len(segment) >= _UDP_HEAD.size:
            source, target, size, _ = _UDP_HEAD.unpack_from(segment)
            if _UDP_HEAD.size <= size <= len(segment):
                yield UdpPacket(t_ns, source, target, segment[_UDP_HEAD.size : size])


def _tcp_segment(t_ns: int, addresses: bytes, segment: bytes) -> TcpSegment | None:
    """Return the TCP segment of an IP packet between two addresses; None if it is truncated."""
    if len(segment) < _TCP_HEAD.size:
        return None
    source, target, sequence, _, size, flags = _TCP_HEAD.unpack_from(segment)
    half = len(addresses) // 2
    begins = bool(flags & _SYN)
    return TcpSegment(
        t_ns,
        (addresses[:half], source),
        (addresses[half:], target),
        sequence + begins & 0xFFFFFFFF,  # a SYN takes one sequence number
        begins,
        segment[max(size >> 4, 5) * 4 :],
    )


# --- files ------------------------------------------------------------------------------------


def _read_frames(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield time, link type and bytes of each packet of a file."""
    return _read_pcapng(data) if data.startswith(PCAPNG_MAGIC) else _read_pcap(data)


class _Interface(NamedTuple):
    link: int
    most: int
    """Largest number of captured bytes of a packet; 0 without a limit."""
    ticks_per_s: int
    offset_s: int


def _read_pcapng(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    order = "<"
    interfaces: list[_Interface] = []
    at = t_ns = 0
    while at + _BLOCK_EDGES <= len(data):
        if data[at : at + 4] == PCAPNG_MAGIC:
            order = "<" if data[at + 8 : at + 12] == _LITTLE_MAGIC else ">"
        kind, size = struct.unpack_from(order + "II", data, at)
        if size < _BLOCK_EDGES or size % 4 or at + size > len(data):
            return

        body = data[at + 8 : at + size - 4]
        at += size
        if kind == _SECTION:
            interfaces = []
        elif kind == _INTERFACE and len(body) >= _INTERFACE_HEAD:
            interfaces.append(_interface(body, order))
        elif kind in {_PACKET, _OLD_PACKET} and len(body) >= _PACKET_HEAD:
            layout = "4I" if kind == _PACKET else "H2x3I"
            number, high, low, captured = struct.unpack_from(order + layout, body)
            if number < len(interfaces):
                link, _, ticks_per_s, offset_s = interfaces[number]
                t_ns = (high << 32 | low) * 10**9 // ticks_per_s + offset_s * 10**9
                yield t_ns, link, body[_PACKET_HEAD : _PACKET_HEAD + captured]
        elif kind == _SIMPLE_PACKET and interfaces:
            (size,) = struct.unpack_from(order + "I", body.ljust(4, b"\0"))
            most = interfaces[0].most or size
            yield t_ns, interfaces[0].link, body[4 : 4 + min(size, most)]


def _interface(body: bytes, order: str) -> _Interface:
    ticks_per_s, offset_s = 10**6, 0
    at = _INTERFACE_HEAD
    while at + 4 <= len(body):
        code, size = struct.unpack_from(order + "HH", body, at)
        value = body[at + 4 : at + 4 + size]
        at += 4 + (size + 3) // 4 * 4

        if code == _RESOLUTION and size == 1:
            power = value[0] & 0x7F
            ticks_per_s = 2**power if value[0] & 0x80 else 10**power
        elif code == _OFFSET and size == len(value) == _OFFSET_BYTES:
            (offset_s,) = struct.unpack(order + "q", value)
    link, most = struct.unpack_from(order + "H2xI", body)
    return _Interface(link, most, ticks_per_s, offset_s)


def _read_pcap(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    order, ns = PCAP_MAGICS[data[:4]]
    if len(data) < _PCAP_HEAD:
        return
    link = struct.unpack_from(order + "I", data, 20)[0] & 0xFFFF
    at = _PCAP_HEAD
    while at + 16 <= len(data):
        seconds, fraction, captured = struct.unpack_from(order + "III", data, at)
        at += 16
        if at + captured > len(data):
            return
        yield seconds * 10**9 + fraction * ns, link, data[at : at + captured]
        at += captured


# --- links and IP -----------------------------------------------------------------------------


def _ip_offset(frame: bytes, link: int) -> int | None:
    """Return the offset of the IP header; None if the frame contains no IP packet."""
    if link == _ETHERNET:
        at = 12
        while frame[at : at + 2] in {kind.to_bytes(2, "big") for kind in _VLAN}:
            at += 4
        head, kind_at = at + 2, at
    else:
        head, place = _LINK_HEADS.get(link, (0, -1))
        if place is None:
            return head
        kind_at = place

    if kind_at < 0 or frame[kind_at : kind_at + 2] not in _IP:
        return None
    return head


class _IpPacket(NamedTuple):
    """One IP packet that contains a whole UDP or TCP segment, or a fragment of a segment."""

    protocol: int
    addresses: bytes
    """Source and destination address."""
    number: int
    """Identification that is common to all fragments of one datagram."""
    more: bool
    """Whether further fragments follow."""
    offset: int
    """Position of the payload in the segment, bytes."""
    body: bytes


def _ip_packet(packet: bytes) -> _IpPacket | None:
    """Return an IPv4 or IPv6 packet of UDP or TCP; None for any other or truncated packet."""
    version = packet[0] >> 4 if packet else 0
    found = None
    if version == 4 and len(packet) >= _IPV4_HEAD:  # noqa: PLR2004 - IPv4
        total, number, flags = struct.unpack_from(">HHH", packet, 2)
        body = packet[(packet[0] & 15) * 4 : total or len(packet)]
        more, offset = bool(flags & 0x2000), (flags & 0x1FFF) * 8
        found = _IpPacket(packet[9], packet[12:20], number, more, offset, body)
    elif version == 6 and len(packet) >= _IPV6_HEAD:  # noqa: PLR2004 - IPv6
        found = _ipv6_packet(packet)
    return found if found is not None and found.protocol in {_TCP, _UDP} else None


def _ipv6_packet(packet: bytes) -> _IpPacket | None:
    """Return an IPv6 packet without its extension headers; None if a header is truncated."""
    size, kind = struct.unpack_from(">HB", packet, 4)
    at, end = _IPV6_HEAD, _IPV6_HEAD + size if size else len(packet)
    number = fields = 0
    while kind in _EXTENSIONS:
        if at + 8 > len(packet):
            return None
        following, units = packet[at], packet[at + 1]
        if kind == _FRAGMENT:
            fields, number = struct.unpack_from(">HI", packet, at + 2)
            units = 0
        kind, at = following, at + 8 * (units + 1)
        if fields & 0xFFF8:
            break  # only the first fragment contains further headers
    return _IpPacket(kind, packet[8:40], number, bool(fields & 1), fields & 0xFFF8, packet[at:end])


class _Fragments:
    """Reassembly of fragments; incomplete datagrams are dropped."""

    def __init__(self) -> None:
        self._pending: dict[tuple[int, bytes, int], _Parts] = {}

    def segment(self, packet: _IpPacket) -> bytes | None:
        """Return the UDP or TCP segment that `packet` contains or completes, if any."""
        protocol, addresses, number, more, offset, body = packet
        if not more and not offset:
            return body

        key = (protocol, addresses, number)
        parts = self._pending.setdefault(key, _Parts())
        if len(self._pending) > _MAX_PENDING:
            del self._pending[next(iter(self._pending))]

        if not parts.add(offset, body, more=more):
            return None
        self._pending.pop(key, None)
        return parts.join()


class _Parts:
    """The fragments of one datagram."""

    def __init__(self) -> None:
        self._bodies: dict[int, bytes] = {}
        self._held = 0
        self._end: int | None = None

    def add(self, offset: int, body: bytes, *, more: bool) -> bool:
        """Add a fragment; return whether the datagram has all its bytes."""
        self._held += len(body) - len(self._bodies.get(offset, b""))
        self._bodies[offset] = body
        if not more:
            self._end = offset + len(body)
        return self._end is not None and self._held >= self._end

    def join(self) -> bytes | None:
        """Return the whole datagram; None if fragments overlap or leave gaps."""
        whole = bytearray()
        for offset, body in sorted(self._bodies.items()):
            if offset != len(whole):
                return None
            whole += body
        return bytes(whole) if len(whole) == self._end else None
