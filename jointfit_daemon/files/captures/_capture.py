"""Recorded bytes of any wire as chunks, for `jointfit decode`.

The file type is determined from the first bytes, not from the name:

| file | wire | chunks |
|---|---|---|
| pcapng, pcap | datagram | one per UDP datagram, both directions, at the packet's own time |
| ``candump -L`` text | can | one per line, a record of `jointfit_protocols.can_frame` |
| raw bytes | stream | pieces of 4096 bytes; the time is that of 921 600 baud |
| raw bytes | datagram | messages ``u16 id, u16 length, …`` that fit exactly, else one datagram |
| raw bytes | can | consecutive records of `jointfit_protocols.can_frame` |
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from jointfit_daemon.files.captures._candump import RECORD_BYTES, is_candump, read_candump
from jointfit_daemon.files.captures._packet_capture import PCAP_MAGICS, PCAPNG_MAGIC, read_udp
from jointfit_daemon.files.text import reject_device
from jointfit_daemon.model import Chunk

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Wire

PIECE = 4096
"""Bytes per chunk of a raw stream."""

NS_PER_BYTE = 10 * 10**9 // 921_600
"""Assumed duration of a byte in a raw stream, ns: ten bits at 921 600 baud."""


class UnreadableCaptureError(ValueError):
    """File that is not a capture of this wire; the message names both types.

    Parameters
    ----------
    text
        The message.
    recorded
        Wire that was recorded; None if unknown.
    """

    def __init__(self, text: str, recorded: Wire | None = None) -> None:
        super().__init__(text)
        self.recorded = recorded


def read_capture(path: Path, wire: Wire, port: int | None = None) -> Iterator[Chunk]:
    """Yield the chunks recorded in a file, in file order.

    Parameters
    ----------
    path : Path
        pcapng, pcap, ``candump -L`` text or raw bytes.
    wire : {"stream", "datagram", "can"}
        Kind of the driver's chunks.
    port : int, optional
        Select UDP datagrams from or to this port.

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
        _require_wire(path, "a network capture", "datagram", wire)
        return (
            Chunk(packet.t_ns, packet.payload)
            for packet in read_udp(data)
            if port is None or port in (packet.source_port, packet.target_port)
        )
    if is_candump(data):
        _require_wire(path, "candump text", "can", wire)
        return read_candump(data)

    if wire == "datagram":
        return _walk(data)
    if wire == "can" and len(data) % RECORD_BYTES:
        raise UnreadableCaptureError(
            f"{path}: neither `candump -L` text nor CAN records of {RECORD_BYTES} bytes: record"
            " with `candump -L can0`"
        )
    size = PIECE // RECORD_BYTES * RECORD_BYTES if wire == "can" else PIECE
    return (Chunk(at * NS_PER_BYTE, data[at : at + size]) for at in range(0, len(data), size))


def _require_wire(path: Path, found: str, recorded: Wire, expected: Wire) -> None:
    if recorded != expected:
        raise UnreadableCaptureError(
            f"{path}: {found}, where a {expected} is expected: name the driver of the device that"
            " was recorded",
            recorded,
        )


def _walk(data: bytes) -> Iterator[Chunk]:
    """Yield messages ``u16 id, u16 length, …`` if they fill the file exactly; else all of it."""
    cuts = [0]
    while cuts[-1] + 4 <= len(data):
        (size,) = struct.unpack_from("<H", data, cuts[-1] + 2)
        cuts.append(cuts[-1] + 4 + size)
    if cuts[-1] != len(data):
        cuts = [0, len(data)]
    for number, at in enumerate(cuts[:-1]):
        yield Chunk(number, data[at : cuts[number + 1]])
