"""One connection to a Vicon DataStream server, from its start until it is lost or silent.

1. The server sends the ids of the objects that it offers. The driver answers with the ids that it
   requires.
2. The driver sends RequestFrame, and frames follow.
3. The driver sends one ping per second. Its round-trip time is an upper bound of the network delay.

Every packet is emitted in the order of arrival, so that a replay has the same input.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_drivers.motion_capture import ServerOutput, TcpLink
from jointfit_protocols import vicon
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vicon import ObjectId

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.motion_capture import Route
    from jointfit_drivers.ports.tcp_connection import ReceivedBytes
    from jointfit_drivers.vicon._settings import ViconSettings

OFFER_S = 3.0
"""Longest wait for the offer of the server, s."""
PING_S = 1.0
"""Interval between pings, s."""
START = "start the Vicon software and go live"
_WANTED = frozenset((
    ObjectId.STREAM_INFO, ObjectId.SUBJECT_INFO, ObjectId.FRAME_INFO, ObjectId.GLOBAL_SEGMENTS,
    ObjectId.LABELED_RECONS, ObjectId.TIMECODE, ObjectId.LATENCY_INFO, ObjectId.HARDWARE_FRAME,
    ObjectId.APPLICATION_INFO, ObjectId.OBJECT_QUALITY, ObjectId.PING,
))  # fmt: skip
_FRAME_MARK = ObjectId.FRAME_INFO.to_bytes(4, "little") + (4).to_bytes(4, "little")
"""Beginning of a FrameInfo object, which every frame contains."""


class ViconSession:
    """One connection. After a loss, the driver creates a new session.

    Parameters
    ----------
    settings : ViconSettings
        The ``[mocap]`` table.
    route : Route
        Addresses of the server and of this host's network card.
    emit : Emit
        Function that receives every packet of the server.
    output : ServerOutput, optional
        Output that is shared with the earlier connections.
    """

    def __init__(
        self, settings: ViconSettings, route: Route, emit: Emit, output: ServerOutput | None = None
    ) -> None:
        self._settings = settings
        self._route = route
        self._output = output or ServerOutput()
        self._output.begin(emit)
        self.offered: frozenset[int] | None = None
        """Ids of the objects that the server offers."""
        self._name = f"Vicon server {settings.server}:{settings.command_port}"
        self._link = TcpLink(self._name, f"{START}, and check command_port", self._read)
        self._stream = vicon.ViconStream()
        self._frame_ns = 0

    async def run(self) -> None:
        """Connect and read until cancelled. The errors are those of `ViconMocap.run`."""
        with self._link as link:
            await link.open(self._route, self._settings.command_port)
            offered = await self._wait_for_offer()
            link.send(vicon.encode(vicon.ObjectEnums(wanted_ids(offered))))
            link.send(vicon.encode(vicon.RequestFrame(stream=True)))

            began_ns, ping_at = time.monotonic_ns(), 0.0
            while True:
                now = time.monotonic()
                if now >= ping_at:
                    link.send(vicon.encode(vicon.ViconPing(time.monotonic_ns())))
                    ping_at = now + PING_S

                silence_s = self._settings.silence_s
                if (time.monotonic_ns() - max(self._frame_ns, began_ns)) / 1e9 >= silence_s:
                    self._output.silent = True
                    raise DeviceLostError(
                        f"{self._name}: no frame for {silence_s:g} s: {START}, or let "
                        "`jointfit doctor` name the cause"
                    )
                await link.pause(min(ping_at - now, silence_s / 4))

    async def _wait_for_offer(self) -> frozenset[int]:
        until = time.monotonic() + OFFER_S
        while self.offered is None:
            if time.monotonic() >= until:
                raise DeviceLostError(
                    f"{self._name}: connected, but no offer within {OFFER_S:g} s: check server and "
                    "command_port (801 unless changed)"
                )
            await self._link.pause(until - time.monotonic())
        if not self.offered & {ObjectId.GLOBAL_SEGMENTS, ObjectId.LABELED_RECONS,
                               ObjectId.LIGHT_SEGMENTS}:  # fmt: skip
            raise DeviceMisconfiguredError(
                f"{self._name} offers neither segments nor labeled markers: check the licence and "
                "the output settings of the Vicon software"
            )
        return self.offered

    def _read(self, segment: ReceivedBytes) -> None:
        for packet in self._stream.feed(segment.data):
            if not isinstance(packet, CorruptBytes):
                self._take(Chunk(segment.t_ns, packet))
            elif self.offered is not None:
                raise DeviceLostError(f"{self._name}: invalid packet header: connecting again")
            else:
                raise DeviceMisconfiguredError(
                    f"{self._name}: the program that answers is not a Vicon DataStream: check "
                    "server and command_port (801 unless changed)"
                )

    def _take(self, chunk: Chunk) -> None:
        if self.offered is None:
            packet = vicon.decode(chunk.data)
            if isinstance(packet, vicon.Packet):
                for item in packet.objects:
                    if isinstance(item, vicon.ObjectEnums):
                        self.offered = item.ids
                        self._link.wake()

        if _FRAME_MARK in chunk.data:
            self._frame_ns = chunk.t_ns
            self._output.emit_frame(chunk)
        else:
            self._output.emit_answer(chunk)


def wanted_ids(offered: frozenset[int]) -> frozenset[int]:
    """Return the ids to request; light-weight segments only if no global segments are offered."""
    wanted = _WANTED
    if ObjectId.GLOBAL_SEGMENTS not in offered:
        wanted |= {ObjectId.LIGHT_SEGMENTS}
    return wanted & offered | {ObjectId.CONTENTS}
