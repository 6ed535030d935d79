"""Conversion of recorded bytes of any wire to chunks, for `jointfit decode`.

The file type is determined from the first bytes, not from the name:

| file | wire | chunks |
|---|---|---|
| pcapng, pcap | datagram | one per UDP datagram, both directions, with the time of the packet |
| pcapng, pcap | datagram, split | as above, and one per packet in one direction of a connection |
| pcapng, pcap | stream | one per segment in one direction of a TCP connection |
| pcapng, pcap | can | one per classic CAN frame of a SocketCAN link |
| ``candump`` text | can | one per line, a record of `jointfit_protocols.can` |
| raw bytes | stream | one per 4096 bytes; the times are computed for 921 600 baud |
| raw bytes | datagram, split | one per packet |
| raw bytes | datagram | one per message ``u16 id, u16 length, …``; else one for the whole file |
| raw bytes | can | one per 170 records of `jointfit_protocols.can` |

*Split* marks a driver with a `packet_stream`, whose chunks are packets of a TCP connection.
"""

from __future__ import annotations

import heapq
import struct
from itertools import islice
from typing import TYPE_CHECKING

from jointfit_daemon.files.captures._candump import (
    RECORD_BYTES,
    is_candump,
    pack_can_frame,
    read_candump,
)
from jointfit_daemon.files.captures._packet_capture import (
    PCAP_MAGICS,
    PCAPNG_MAGIC,
    TcpSegment,
    UdpPacket,
    read_can,
    read_packets,
)
from jointfit_daemon.files.captures._tcp_streams import Piece, directions, split_pieces
from jointfit_daemon.files.text import reject_device
from jointfit_daemon.model import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Wire
    from jointfit_daemon.files.captures._tcp_streams import Splitter

    Rating = Callable[[Iterable[Chunk]], int]
    """Function that returns the number of messages that a decoder finds in the given chunks."""

PIECE = 4096
"""Number of bytes per chunk of a raw stream."""

NS_PER_BYTE = 10 * 10**9 // 921_600
"""Assumed duration of a byte in a raw stream, ns: ten bits at 921 600 baud."""

_RATED = 2000
"""Number of chunks of each TCP direction that are decoded to choose the best direction."""


class UnreadableCaptureError(ValueError):
    """The file is not a capture of the requested wire; the message names both types of wire.

    Parameters
    ----------
    text
        The message.
    recorded
        Wire that the file contains; None if unknown.
    """

    def __init__(self, text: str, recorded: Wire | None = None) -> None:
        super().__init__(text)
        self.recorded = recorded


def read_capture(
    path: Path,
    wire: Wire,
    port: int | None = None,
    *,
    split: Callable[[], Splitter] | None = None,
    rate: Rating | None = None,
) -> Iterator[Chunk]:
    """Yield the chunks recorded in a file, in file order.

    Parameters
    ----------
    path : Path
        pcapng, pcap, ``candump -L`` text or raw bytes.
    wire : {"stream", "datagram", "can"}
        Kind of the driver's chunks.
    port : int, optional
        Select UDP datagrams from or to this port.
    split : callable, optional
        Function that returns a new splitter, which divides the bytes of a connection into chunks.
    rate : callable, optional
        Function that returns the number of messages in the chunks of one direction of a TCP
        connection. The direction with the most messages is used. Without this function, TCP
        connections are ignored.

    Raises
    ------
    UnreadableCaptureError
        The file is a capture of another kind of wire.
    OSError
        The file cannot be read.
    """
    reject_device(path)
    data = path.read_bytes()
    if data.startswith(PCAPNG_MAGIC) or data[:4] in PCAP_MAGICS:
        if wire == "can":
            frames = [
                Chunk(
                    one.t_ns,
                    pack_can_frame(
                        *one[:3], extended=one.extended, remote=one.remote, error=one.error
                    ),
                )
                for one in read_can(data)
            ]
            if frames:
                return iter(frames)
        return _network(path, data, wire, port, split=split, rate=rate)
    if is_candump(data):
        _require_wire(path, "candump text", "can", wire)
        return read_candump(data)

    if wire == "datagram":
        return _walk(data) if split is None else split_pieces([Piece(0, data, False)], split)
    if wire == "can" and len(data) % RECORD_BYTES:
        raise UnreadableCaptureError(
            f"{path}: neither `candump -L` text nor CAN records of {RECORD_BYTES} bytes: record"
            " with `candump -L can0`"
        )
    size = PIECE // RECORD_BYTES * RECORD_BYTES if wire == "can" else PIECE
    return (Chunk(at * NS_PER_BYTE, data[at : at + size]) for at in range(0, len(data), size))


def _network(
    path: Path,
    data: bytes,
    wire: Wire,
    port: int | None,
    *,
    split: Callable[[], Splitter] | None,
    rate: Rating | None,
) -> Iterator[Chunk]:
    """Return the chunks of a network capture; see `read_capture`."""
    packets = list(read_packets(data))
    by_tcp: list[Chunk] = []
    if rate is not None and (wire == "stream" or split is not None):
        found = directions(packet for packet in packets if isinstance(packet, TcpSegment))
        rated = [_pieces_as_chunks(pieces, split) for pieces in found]
        by_tcp = max(rated, key=lambda chunks: rate(islice(chunks, _RATED)), default=[])
    if wire != "datagram" and not by_tcp:
        _require_wire(path, "a network capture", "datagram", wire)
    if wire == "stream":
        return iter(by_tcp)

    by_udp = (
        Chunk(packet.t_ns, packet.payload)
        for packet in packets
        if isinstance(packet, UdpPacket)
        and (port is None or port in (packet.source_port, packet.target_port))
    )
    return heapq.merge(by_udp, by_tcp, key=lambda chunk: chunk.t_ns) if by_tcp else by_udp


def _pieces_as_chunks(pieces: Iterable[Piece], split: Callable[[], Splitter] | None) -> list[Chunk]:
    if split is not None:
        return list(split_pieces(pieces, split))
    return [Chunk(piece.t_ns, piece.data) for piece in pieces]


def _require_wire(path: Path, found: str, recorded: Wire, expected: Wire) -> None:
    if recorded != expected:
        raise UnreadableCaptureError(
            f"{path}: {found}, but the driver reads {expected} data: name the driver of the device"
            " that was recorded",
            recorded,
        )


def _walk(data: bytes) -> Iterator[Chunk]:
    """Yield a chunk per message ``u16 id, u16 length, …``.

    If such messages do not fill the file exactly, yield the whole file as one chunk.
    """
    cuts = [0]
    while cuts[-1] + 4 <= len(data):
        (size,) = struct.unpack_from("<H", data, cuts[-1] + 2)
        cuts.append(cuts[-1] + 4 + size)
    if cuts[-1] != len(data):
        cuts = [0, len(data)]
    for number, at in enumerate(cuts[:-1]):
        yield Chunk(number, data[at : cuts[number + 1]])
