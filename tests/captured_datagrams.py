"""The UDP datagrams of a packet capture, which tests of protocols and drivers replay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.files.captures._packet_capture import UdpPacket, read_packets

if TYPE_CHECKING:
    from collections.abc import Iterator


def read_udp(data: bytes) -> Iterator[UdpPacket]:
    """Yield the UDP datagrams of a pcapng or pcap file in file order."""
    return (packet for packet in read_packets(data) if isinstance(packet, UdpPacket))
