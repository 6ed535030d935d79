"""Simulated VRPN server with trackers over TCP and UDP, in classic and direct connections.

Invariants: the server sends no message for a body that is not visible. The time stamp of a message
is the time of its creation on the server's wall clock, which can step. The numbers of types and
senders differ from the numbers in clients.
"""

from __future__ import annotations

import asyncio
import random
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vrpn import (
    MAJOR,
    TYPE_NAMES,
    VELOCITY,
    Cookie,
    Ping,
    Pong,
    SenderDescription,
    TrackerMotion,
    TrackerPose,
    TypeDescription,
    UdpChannel,
    VrpnCodec,
    VrpnContent,
    decode_announcement,
    encode,
)
from jointfit_simulators.devices._natnet_frames import axes_from_z_up
from jointfit_simulators.devices._vrpn_options import VrpnServerOptions
from jointfit_simulators.devices._vrpn_port import LOOPBACK, VrpnPeer, VrpnPort

if TYPE_CHECKING:
    import socket

    from jointfit_simulators.devices._natnet_frames import Bodies, Markers, Pose
    from jointfit_simulators.devices._natnet_port import Address

_FIRST_SENDER, _FIRST_TYPE = 3, 11
"""First numbers of trackers and types. In real servers, the connection itself uses the smaller
numbers."""
_CONTROL = "VRPN Control"
_MOST_DATAGRAM = 1472
_I32_MAX = b"\x7f\xff\xff\xff"
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(eq=False)
class _VrpnClient:
    peer: VrpnPeer
    codec: VrpnCodec = field(default_factory=VrpnCodec)
    greeted: bool = False
    udp: Address | None = None
    sequence: int = 0
    described: set[str] = field(default_factory=set)
    held: bytes | None = None
    sent: int = 0


class VrpnServer:
    """Simulated server. Its port is open from the start, and `run` answers clients.

    Attributes
    ----------
    ready : asyncio.Event
        Event that is set while `run` answers.
    number : int
        Number of the next frame. VRPN does not send this number.
    stepped_ns : int
        Step of the server's wall clock, ns; tests can set it.
    """

    def __init__(self, options: VrpnServerOptions | None = None) -> None:
        self.options = options or VrpnServerOptions()
        self._port = VrpnPort(self.options.port)
        self.command_port = self._port.port
        self._random = random.Random(self.options.seed)  # noqa: S311 - the same draws in every run
        self._place, self._turn = axes_from_z_up(self.options.up_axis)
        self._scale = 1000.0 if self.options.unit == "mm" else 1.0
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        named = {*self.options.bodies, *self.options.markers}
        self._sensors = {name: (name, 0) for name in (*self.options.bodies, *self.options.markers)}
        self._sensors |= {n: place for n, place in self.options.sensors.items() if n in named}
        trackers = dict.fromkeys(tracker for tracker, _ in self._sensors.values())
        self._senders = {name: n for n, name in enumerate(trackers, _FIRST_SENDER)}
        self._types = {name: n for n, name in enumerate(TYPE_NAMES, _FIRST_TYPE)}
        self._clients: list[_VrpnClient] = []
        self.ready = asyncio.Event()
        self.number = 0
        self.stepped_ns = 0
        self._sent_before = 0
        self._made_ns = 0  # earliest host time of the next message

    @property
    def clients(self) -> int:
        """Number of clients that have completed the handshake, the exchange of VRPN's cookies."""
        return sum(client.greeted and client.peer.open for client in self._clients)

    @property
    def sent(self) -> int:
        """Number of sent frames, summed over the clients."""
        return self._sent_before + sum(client.sent for client in self._clients)

    async def run(self) -> None:
        """Answer requests until cancelled."""
        self.ready.set()
        try:
            await self._port.serve(self._accept_connection, self._connect_back)
        finally:
            self.ready.clear()
            self._disconnect_all()

    def unplug(self) -> None:
        """Close the port and all connections, as when the camera software is closed."""
        self._port.unplug()
        self._disconnect_all()

    def plug(self) -> None:
        """Open the same port again."""
        self._port.plug()

    def restart(self) -> None:
        """Close and reopen the server."""
        self.unplug()
        self.plug()
        self.number = 0

    def push(self, exposure_host_ns: int, markers: Markers, bodies: Bodies) -> None:
        """Send one frame now; see `NatNetServer.push`."""
        # Stamps increase from message to message, even if several frames are sent together.
        made_ns = max(time.monotonic_ns(), exposure_host_ns, self._made_ns)
        server_ns = self.options.device_ns(made_ns) + self._epoch_ns + self.stepped_ns
        poses: dict[str, Pose] = {name: pose for name, pose in bodies.items() if pose is not None}
        poses |= {name: (at, _UPRIGHT) for name, at in markers.items() if at is not None}

        messages: list[tuple[str, VrpnContent]] = []
        for name, (tracker, sensor) in self._sensors.items():
            if name not in poses:
                continue
            at, q = self._place(*poses[name][0]), self._turn(*poses[name][1])
            time_us = server_ns // 1000 + len(messages) * self.options.spread_us
            x, y, z = (self._scale * value for value in at)
            sender = self._senders[tracker]
            pose = TrackerPose(time_us, sender, sensor, x, y, z, q[1], q[2], q[3], q[0])
            messages.append((tracker, pose))
            if self.options.velocities:
                motion = TrackerMotion(
                    VELOCITY, time_us, sender, sensor, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.01
                )
                messages.append((tracker, motion))

        self._made_ns = made_ns + 1000 * self.options.spread_us * len(messages)

        self.number += 1
        for client in list(self._clients):
            if not client.peer.open:
                self._sent_before += client.sent
                self._clients.remove(client)
            elif client.greeted and messages:
                client.sent += self._send_frame(client, messages)

    # --- frames -------------------------------------------------------------------------------

    def _send_frame(self, client: _VrpnClient, messages: list[tuple[str, VrpnContent]]) -> bool:
        datagrams = [b""]
        for tracker, message in messages:
            if tracker not in client.described:
                self._describe(client, tracker)
            data = self._encode(client, message)
            if self._random.random() < self.options.hostile:
                data = _I32_MAX + data[4:]
            if len(datagrams[-1]) + len(data) > _MOST_DATAGRAM:
                datagrams.append(b"")
            datagrams[-1] += data

        if client.udp is None:
            whole = self.options.wire_noise(b"".join(datagrams))
            size = self.options.segment_bytes or len(whole)
            return all(client.peer.send(whole[at : at + size]) for at in range(0, len(whole), size))
        for data in datagrams:
            self._send_datagram(client, client.udp, self.options.wire_noise(data))
        return True

    def _send_datagram(self, client: _VrpnClient, address: Address, data: bytes) -> None:
        """Send a datagram; simulate the losses of a network."""
        options, draw = self.options, self._random.random
        if draw() < options.loss:
            return
        if client.held is None and draw() < options.reordering:
            client.held = data
            return
        copies = 2 if draw() < options.duplication else 1
        late, client.held = client.held, None
        for item in [data] * copies + ([late] if late is not None else []):
            self._port.send(item, address)

    # --- connections --------------------------------------------------------------------------

    def _connect_back(self, data: bytes, address: Address) -> None:
        """Connect to a client that announced a classic connection, at the host of its datagram."""
        announcement = decode_announcement(data)
        if not isinstance(announcement, CorruptBytes) and "classic" in self.options.connections:
            self._port.connect_back((address[0], announcement.port))

    def _accept_connection(self, connected: socket.socket) -> None:
        back = connected.getsockname()[1] != self.command_port
        if not back and "tcp" not in self.options.connections:
            connected.close()
            return
        client = _VrpnClient(VrpnPeer(connected, self._take))
        self._clients.append(client)
        client.peer.send(encode(Cookie(*self.options.version)))

    def _take(self, peer: VrpnPeer, data: bytes) -> None:
        (client,) = (client for client in self._clients if client.peer is peer)

        for message in client.codec.feed(data):
            match message:
                case Cookie(major) if major != MAJOR:
                    peer.close()
                case Cookie():
                    self._greet(client)
                case UdpChannel(port, _):
                    client.udp = (peer.host or LOOPBACK, port)
                case Ping(_, number) if self.options.answers_ping:
                    name = client.codec.senders.get(number, "")
                    if name in self._senders:
                        now_us = time.time_ns() // 1000
                        pong = Pong(now_us, self._senders[name])
                        peer.send(self._encode(client, pong))

    def _greet(self, client: _VrpnClient) -> None:
        """Send all descriptions to a new client."""
        descriptions: list[VrpnContent] = [SenderDescription(0, _CONTROL)]
        descriptions += [TypeDescription(number, name) for name, number in self._types.items()]
        for description in descriptions:
            client.peer.send(self._encode(client, description))
        if not self.options.described_late:
            for tracker in self._senders:
                self._describe(client, tracker)
        client.greeted = True

    def _describe(self, client: _VrpnClient, tracker: str) -> None:
        client.described.add(tracker)
        description = SenderDescription(self._senders[tracker], tracker)
        client.peer.send(self._encode(client, description))

    def _encode(self, client: _VrpnClient, message: VrpnContent) -> bytes:
        client.sequence += 1
        return encode(message, self._types, sequence=client.sequence)

    def _disconnect_all(self) -> None:
        for client in self._clients:
            client.peer.close()
            self._sent_before += client.sent
        self._clients.clear()
