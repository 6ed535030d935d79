"""Bytes of simulated devices, which the project's encoders make before the measurement.

Invariant: every function is deterministic and returns chunks in order of arrival.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from jointfit_daemon.model import Chunk
from jointfit_daemon.units import NS_PER_S
from jointfit_protocols import xbus, xcdi
from jointfit_protocols.can import CanFrame, pack_frames, slcan
from jointfit_protocols.natnet import ServerInfo, encode
from jointfit_protocols.xbus import mtdata2
from jointfit_simulators.body import CLUSTERS
from jointfit_simulators.devices import (
    FrameStamps,
    NatNetFrameBuilder,
    RigidBodyAsset,
    model_definition,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Quaternion, Vector

TICK_NS = 100_000
"""Tick of the item SampleTimeFine of an MTi, ns."""
BITSTREAM = (3, 1)
_SERVER = ServerInfo("Motive", (2, 3, 0, 0), (3, 1, 0, 0), 10_000_000)


def xbus_message(number: int, ticks: int, q: Quaternion) -> bytes:
    """Return a message with counter, time, status and quaternion, as a configured MTi sends it."""
    return xbus.encode(
        xbus.XbusMessageId.MT_DATA2,
        mtdata2.encode_items(
            [
                (mtdata2.Item.PACKET_COUNTER, number & 0xFFFF),
                (mtdata2.Item.SAMPLE_TIME_FINE, ticks & 0xFFFFFFFF),
                (mtdata2.Item.STATUS_WORD, 2),
                (mtdata2.real_id(mtdata2.Item.QUATERNION), q),
            ]
        ),
    )


def xbus_messages(orientations: Sequence[Quaternion], period_ns: int) -> list[bytes]:
    """Return one message per sample."""
    return [xbus_message(k, k * period_ns // TICK_NS, q) for k, q in enumerate(orientations)]


def xcdi_frames(
    orientations: Sequence[Quaternion], period_ns: int, ids: xcdi.XcdiIds, start_ns: int = 0
) -> list[list[CanFrame]]:
    """Return three frames per sample: time, counter and quaternion."""
    return [
        [
            CanFrame(start_ns + k * period_ns, can_id, xcdi.encode(data_id, counts))
            for can_id, data_id, counts in (
                (ids.sample_time, xcdi.DataId.SAMPLE_TIME, (k * period_ns // TICK_NS,)),
                (ids.group_counter, xcdi.DataId.GROUP_COUNTER, (k & 0xFFFF,)),
                (ids.quaternion, xcdi.DataId.QUATERNION, xcdi.quaternion_counts(q)),
            )
            if can_id is not None
        ]
        for k, q in enumerate(orientations)
    ]


def xbus_chunks(
    orientations: Sequence[Quaternion], period_ns: int, start_ns: int = 0
) -> list[Chunk]:
    """Return one chunk per sample."""
    messages = xbus_messages(orientations, period_ns)
    return [Chunk(start_ns + k * period_ns, data) for k, data in enumerate(messages)]


def xcdi_chunks(
    orientations: Sequence[Quaternion], period_ns: int, ids: xcdi.XcdiIds, start_ns: int = 0
) -> list[Chunk]:
    """Return one chunk of three frames per sample."""
    groups = xcdi_frames(orientations, period_ns, ids, start_ns)
    return [Chunk(start_ns + k * period_ns, pack_frames(group)) for k, group in enumerate(groups)]


def slcan_lines(groups: Sequence[Sequence[CanFrame]]) -> list[bytes]:
    """Return the frames of each sample in the format of an SLCAN adapter."""
    return [b"".join(slcan.encode_frame(frame) for frame in group) for group in groups]


def natnet_opening() -> list[bytes]:
    """Return the messages that a server sends before its first frame."""
    return [encode(_SERVER), encode(model_definition(_bodies(), BITSTREAM), BITSTREAM)]


def natnet_datagrams(
    count: int, period_ns: int, places: Mapping[str, Vector] | None = None
) -> list[bytes]:
    """Return the frames of a leg with all markers visible and all bodies tracked.

    Parameters
    ----------
    count, period_ns : int
        Number of frames, and their period, ns.
    places : mapping of str to Vector, optional
        Marker positions of a rigid leg, m, z up. The leg sways along all axes. By default, all
        markers are on a line.
    """
    stage = NatNetFrameBuilder(_bodies(), "y", "missing")
    found = []
    for k in range(count):
        ticks = k * period_ns // 100
        stamps = FrameStamps(k, k * period_ns / NS_PER_S, ticks, ticks + 46_000, ticks + 60_000, 0)
        sway = 0.1 * math.sin(k / 20)
        markers = {
            name: (sway + 0.03 * i, 0.2 * i, 0.4 + sway)
            for i, name in enumerate(name for names in CLUSTERS.values() for name in names)
        }
        if places is not None:
            markers = {name: (x + sway, y + sway, z + sway) for name, (x, y, z) in places.items()}
        turn = (math.cos(sway), math.sin(sway), 0.0, 0.0)
        bodies = {body.name: ((sway, 0.0, 1.0), turn) for body in _bodies()}
        found.append(encode(stage.frame(stamps, markers, bodies), BITSTREAM))
    return found


def _bodies() -> tuple[RigidBodyAsset, ...]:
    return tuple(
        RigidBodyAsset(part.capitalize(), names, number)
        for number, (part, names) in enumerate(CLUSTERS.items(), 1)
    )
