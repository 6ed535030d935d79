"""Captures of three types of wires for the sample data. Invariant: no port is opened.

All captures contain the same movement: as raw bytes of an Xbus UART, as the text of ``candump -L``,
and as a pcap file (raw IPv4, nanoseconds) with the datagrams of a NatNet server.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S
from jointfit_protocols import xbus
from jointfit_protocols.natnet import ServerInfo
from jointfit_protocols.natnet import encode as encode_natnet
from jointfit_protocols.orientation import native_of
from jointfit_protocols.xbus import mtdata2
from jointfit_protocols.xbus.configuration import TICK_NS
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices import (
    FrameStamps,
    NatNetFrameBuilder,
    RigidBodyAsset,
    model_definition,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from jointfit_protocols.can import CanFrame
    from jointfit_protocols.xbus.mtdata2 import Value
    from jointfit_simulators.devices import Bodies, Markers
    from jointfit_simulators.imu_device import Quaternion

EPOCH_NS = 1_767_225_600 * 10**9
"""UNIX time of the first sample: 2026-01-01T00:00:00Z, ns."""
_BITSTREAM = (3, 1)
_CLOCK_HZ = 10_000_000
_DATA_PORT, _COMMAND_PORT = 1511, 1510
_PCAP_NANOSECONDS, _RAW_IPV4, _LONGEST = 0xA1B23C4D, 101, 65535
_UDP = 17
_LOOPBACK = bytes([127, 0, 0, 1])


def xbus_bytes(samples: Iterable[tuple[int, Quaternion]]) -> bytes:
    """Return MTData2 messages for pairs of device time (ns) and orientation (sensor to ENU)."""
    messages = []
    for counter, (device_ns, q) in enumerate(samples):
        items: list[tuple[int, Value]] = [
            (Item.PACKET_COUNTER, counter),
            (Item.SAMPLE_TIME_FINE, device_ns // TICK_NS),
            (Item.STATUS_WORD, mtdata2.FILTER_VALID),
            (Item.QUATERNION, native_of(q)),
        ]
        messages.append(xbus.encode(xbus.XbusMessageId.MT_DATA2, mtdata2.encode_items(items)))
    return b"".join(messages)


def candump_text(groups: Iterable[tuple[int, Sequence[CanFrame]]], channel: str) -> str:
    """Return a ``candump -L`` log for pairs of arrival time (ns) and CAN frames."""
    lines = []
    for t_ns, frames in groups:
        for place, frame in enumerate(frames):
            at_us = (EPOCH_NS + t_ns) // 1000 + 100 * place
            lines.append(
                f"({at_us // 10**6}.{at_us % 10**6:06d}) {channel} "
                f"{frame.can_id:03X}#{frame.data.hex().upper()}\n"
            )
    return "".join(lines)


def natnet_pcap(
    clusters: Mapping[str, Sequence[str]],
    frames: Iterable[tuple[int, Markers, Bodies]],
    rate_hz: float,
) -> bytes:
    """Return a capture of a NatNet 3.1 server: the description, and one datagram per frame.

    Parameters
    ----------
    clusters
        Markers by body part. Each part is a marker set and a rigid body of the project.
    frames
        Exposure time (ns since the first frame), markers and rigid bodies, m, z up; None if
        occluded.
    rate_hz
        Frame rate, Hz.
    """
    bodies = tuple(
        RigidBodyAsset(part.capitalize(), tuple(names), number)
        for number, (part, names) in enumerate(clusters.items(), 1)
    )
    builder = NatNetFrameBuilder(bodies, "y", "missing")
    info = ServerInfo(
        "Motive", (3, 0, 0, 0), (*_BITSTREAM, 0, 0), _CLOCK_HZ, _DATA_PORT, False, "239.255.42.99"
    )

    datagrams = [
        (0, encode_natnet(info)),
        (0, encode_natnet(model_definition(bodies, _BITSTREAM), _BITSTREAM)),
    ]
    for number, (exposure_ns, markers, poses) in enumerate(frames):
        ticks = _CLOCK_HZ + exposure_ns * _CLOCK_HZ // NS_PER_S  # a stamp of 0 means unknown
        received, transmitted = ticks + _CLOCK_HZ // 200, ticks + _CLOCK_HZ // 150
        stamps = FrameStamps(number, number / rate_hz, ticks, received, transmitted, 0)
        frame = builder.frame(stamps, markers, poses)
        datagrams.append((exposure_ns + NS_PER_S // 100, encode_natnet(frame, _BITSTREAM)))
    return _pcap(datagrams)


def _pcap(datagrams: Iterable[tuple[int, bytes]]) -> bytes:
    parts = [struct.pack("<IHHiIII", _PCAP_NANOSECONDS, 2, 4, 0, 0, _LONGEST, _RAW_IPV4)]
    for t_ns, payload in datagrams:
        udp = struct.pack(">HHHH", _COMMAND_PORT, _DATA_PORT, 8 + len(payload), 0) + payload
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, _UDP, 0)
        packet = ip + _LOOPBACK + _LOOPBACK + udp
        seconds, nanoseconds = divmod(EPOCH_NS + t_ns, NS_PER_S)
        parts += [struct.pack("<IIII", seconds, nanoseconds, len(packet), len(packet)), packet]
    return b"".join(parts)
