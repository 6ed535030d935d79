"""Simulated server of Qualisys Track Manager (QTM) on the loopback interface.

Invariant: the server sends no text answer to a valid command StreamFrames. One existing client
would treat such an answer as the answer to its next command.
"""

from __future__ import annotations

import asyncio
import random
import socket
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_protocols import qtm
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.qtm import ComponentType, QtmEvent
from jointfit_simulators.devices._natnet_frames import axes_from_z_up
from jointfit_simulators.devices._natnet_options import same_clock
from jointfit_simulators.devices._qtm_frames import (
    components,
    requested_components,
    settings_xml,
)
from jointfit_simulators.devices._tcp_port import TcpPort
from jointfit_simulators.imu_device import WireNoise, clean_wire

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_simulators.devices._natnet_frames import Axis, Bodies, Markers, RigidBodyAsset
    from jointfit_simulators.devices._tcp_port import TcpClient

_NEWEST = (1, 28)
"""Newest version of the protocol of QTM. The driver `qtm` requests an older version."""
_OLDEST = (1, 19)
_FIRST: tuple[int, int] = (1, 1)
"""Protocol version for a client that selects no version."""
_HUGE = struct.pack("<I", 2**32 - 1)
_TEXTS = {
    "byteorder": "Byte order is little endian",
    "qtmversion": "QTM Version is 2026.1 (build 1)",
}


@dataclass(frozen=True, slots=True)
class QtmServerOptions:
    """Constant properties of a server."""

    bodies: tuple[RigidBodyAsset, ...] = ()
    newest: tuple[int, int] = _NEWEST
    """Newest supported version of the protocol."""
    oldest: tuple[int, int] = _OLDEST
    """Oldest supported version of the protocol. A future QTM may reject old versions."""
    command_port: int = 0
    """TCP port on the loopback interface; 0 selects a free port."""
    discovery_port: int | None = None
    """UDP port for discovery requests; None if they are not answered."""
    up_axis: Axis = "z"
    rate_hz: float = 120.0
    camera_time: bool = True
    """Whether frames contain the camera time."""
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the camera clock, both in ns."""
    relative: tuple[str, ...] = ()
    """Bodies whose pose is relative to another body."""
    most_clients: int = 10
    split: bool = False
    """Whether frames over UDP are split into one datagram per component."""
    pieces: int = 1
    """Number of TCP segments per frame."""
    numbers_stand: bool = False
    """Whether the frame number is always 1, as in the live preview."""
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    """Probability that a datagram is sent after its successor. `loss` and `duplication` are also
    probabilities per datagram."""
    hostile: float = 0.0
    """Probability that a frame contains a wrong count or length."""
    wire_noise: WireNoise = clean_wire
    """Noise applied to each frame."""
    seed: int = 1


@dataclass(slots=True)
class QtmClient:
    """State of one client."""

    wire: TcpClient
    stream: qtm.QtmStream = field(default_factory=qtm.QtmStream)
    version: tuple[int, int] = _FIRST
    kinds: tuple[ComponentType, ...] = ()
    """Components to stream; empty before the command StreamFrames."""
    udp: tuple[str, int] | None = None
    held: bytes | None = None
    """Datagram that is sent after its successor."""


class QtmServer:
    """Simulated server. Its port is open from the start, and `run` answers commands.

    Attributes
    ----------
    ready : asyncio.Event
        Event that is set while `run` answers.
    number : int
        Number of the next frame; tests can set it to simulate a jump.
    measuring : bool
        Whether a measurement is running; otherwise, the server sends no data.
    """

    def __init__(self, options: QtmServerOptions | None = None) -> None:
        self.options = options or QtmServerOptions()
        self._port = TcpPort(self.options.command_port)
        self.command_port = self._port.port
        """TCP port for commands of clients."""
        self._udp = _udp_socket()
        self._clients: dict[TcpClient, QtmClient] = {}
        self._bodies = self.options.bodies
        self._axes = axes_from_z_up(self.options.up_axis)
        self._random = random.Random(self.options.seed)  # noqa: S311 - the same draws in every run
        self.ready = asyncio.Event()
        self.number = 1
        self.measuring = True
        self.sent = 0
        """Number of sent frames, summed over the clients."""
        self._state = QtmEvent.CAPTURE_STARTED
        self._began_ns: int | None = None

    @property
    def streaming(self) -> int:
        """Number of clients that stream."""
        return sum(bool(client.kinds) for client in self._clients.values())

    async def run(self) -> None:
        """Answer requests until cancelled."""
        self.ready.set()
        try:
            if self.options.discovery_port is None:
                await self._port.serve(self._join, self._handle)
            else:
                await self._serve_discovery(self.options.discovery_port)
        finally:
            self.ready.clear()

    async def _serve_discovery(self, port: int) -> None:
        loop = asyncio.get_running_loop()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as discovery:
            discovery.setblocking(False)
            discovery.bind(("127.0.0.1", port))
            loop.add_reader(discovery, self._announce, discovery)
            try:
                await self._port.serve(self._join, self._handle)
            finally:
                loop.remove_reader(discovery)

    def _announce(self, discovery: socket.socket) -> None:
        data, address = discovery.recvfrom(64)
        message = qtm.decode(data)
        if isinstance(message, qtm.Discover):
            text = "simulator, QTM 2026.1 (build 1), 8 cameras"
            answer = qtm.ServerAnnouncement(text, self.command_port - 1)
            discovery.sendto(qtm.encode_announcement(answer), (address[0], message.port))

    def unplug(self) -> None:
        """Close the port and disconnect all clients."""
        self._port.unplug()
        self._udp.close()
        self._clients.clear()

    def plug(self) -> None:
        """Open the same port again."""
        self._port.plug()
        self._udp.close()
        self._udp = _udp_socket()

    def restart(self) -> None:
        """Close and reopen the server; a new measurement begins."""
        self.unplug()
        self.plug()
        self.number, self._began_ns = 1, None

    # --- the operator -------------------------------------------------------------------------

    def set_bodies(self, bodies: tuple[RigidBodyAsset, ...]) -> None:
        """Replace the rigid bodies and their markers during the run."""
        self._bodies = bodies
        self.report(QtmEvent.CAMERA_SETTINGS_CHANGED)

    def stop_measurement(self) -> None:
        """End the measurement; clients receive the message "no more data"."""
        self.measuring = False
        self.report(QtmEvent.CAPTURE_STOPPED)
        for client in self._clients.values():
            if client.kinds:
                client.wire.send(qtm.encode(qtm.NoMoreData()))

    def start_measurement(self, event: QtmEvent = QtmEvent.CAPTURE_STARTED) -> None:
        """Begin a measurement; the event ``RT_FROM_FILE_STARTED`` begins the playback of a file."""
        self.measuring, self._began_ns, self.number = True, None, 1
        self.report(event)

    def report(self, event: QtmEvent) -> None:
        """Send an event to all clients."""
        self._state = event
        for client in self._clients.values():
            client.wire.send(qtm.encode(qtm.Event(event)))

    def push(self, exposure_host_ns: int, markers: Markers, bodies: Bodies) -> None:
        """Send one frame now.

        Parameters
        ----------
        exposure_host_ns : int
            Exposure time, host CLOCK_MONOTONIC, ns. It is independent of the time of sending.
        markers : mapping of str to (x, y, z) or None
            Position in the world (z up), m; None if occluded. Markers without a body are sent as
            unlabeled.
        bodies : mapping of str to (position, quaternion) or None
            Position in the world (z up), m, and q_world_body (w, x, y, z); None if untracked.
        """
        if not self.measuring:
            return
        device_ns = self.options.device_ns(exposure_host_ns)
        if self._began_ns is None:
            self._began_ns = device_ns
        stamp_us = (device_ns - self._began_ns) // 1000
        number = 1 if self.options.numbers_stand else self.number
        self.number += 1

        ticks = device_ns // 100 if self.options.camera_time else None
        made: dict[tuple[ComponentType, ...], list[qtm.Component]] = {}
        for client in tuple(self._clients.values()):
            if client.kinds:
                if client.kinds not in made:
                    made[client.kinds] = components(
                        client.kinds,
                        markers,
                        bodies,
                        assets=self._bodies,
                        axes=self._axes,
                        camera_ticks=ticks,
                    )
                self._send_frame(client, stamp_us, number, made[client.kinds])

    def _send_frame(
        self, client: QtmClient, stamp_us: int, number: int, parts: list[qtm.Component]
    ) -> None:
        split = self.options.split and client.udp is not None
        groups = [(part,) for part in parts] if split else [tuple(parts)]
        sent = True
        for group in groups:
            data = qtm.encode(qtm.DataFrame(stamp_us, number, group))
            if self._random.random() < self.options.hostile:
                at = self._random.choice((20, 24, 32))
                data = data[:at] + _HUGE + data[at + 4 :]
            data = self.options.wire_noise(data)
            sent &= self._send(client, data)
        self.sent += sent

    def _send(self, client: QtmClient, data: bytes) -> bool:
        if client.udp is None:
            return client.wire.send(data, pieces=self.options.pieces)

        options, draw = self.options, self._random.random
        if draw() < options.loss:
            return False
        if client.held is None and draw() < options.reordering:
            client.held = data
            return True
        copies = 2 if draw() < options.duplication else 1
        late, client.held = client.held, None
        for item in [data] * copies + ([late] if late is not None else []):
            try:
                self._udp.sendto(item, client.udp)
            except OSError:  # client closed or queue full; UDP loses the datagram
                return False
        return True

    # --- commands -----------------------------------------------------------------------------

    def _join(self, wire: TcpClient) -> None:
        if len(self._port.clients) > self.options.most_clients:
            text = "Connection refused. Max number of clients reached."
            wire.send(qtm.encode(qtm.ErrorReply(text)))
            self._port.drop(wire)
            return
        self._clients = {w: c for w, c in self._clients.items() if w in self._port.clients}
        self._clients[wire] = QtmClient(wire)
        wire.send(qtm.encode(qtm.Command("QTM RT Interface connected")))

    def _handle(self, wire: TcpClient, data: bytes) -> None:
        client = self._clients.get(wire)
        if client is None:
            return
        for packet in client.stream.feed(data):
            message = packet if isinstance(packet, CorruptBytes) else qtm.decode(packet)
            if isinstance(message, qtm.Command):
                answer = self._answer(client, message.text)
                if answer is not None:
                    wire.send(qtm.encode(answer))

    def _answer(self, client: QtmClient, command: str) -> qtm.Message | None:
        word, *words = command.lower().split()
        if word in _TEXTS:
            return qtm.Command(_TEXTS[word])
        if word == "version":
            return self._select_version(client, words)
        if word == "getstate":
            return qtm.Event(self._state)
        if word == "getparameters":
            options = self.options
            return qtm.SettingsReply(
                settings_xml(
                    words, client.version, self._bodies, rate_hz=options.rate_hz,
                    up_axis=options.up_axis, camera_time=options.camera_time,
                    relative=options.relative,
                )
            )  # fmt: skip
        if word == "streamframes":
            return self._stream_frames(client, words)
        return qtm.ErrorReply("Parse error")

    def _select_version(self, client: QtmClient, words: list[str]) -> qtm.Message:
        if not words:
            return qtm.Command("Version is {}.{}".format(*client.version))
        major, _, minor = words[0].partition(".")
        if major.isdecimal() and minor.isdecimal():
            version = int(major), int(minor)
            if self.options.oldest <= version <= self.options.newest:
                client.version = version
                return qtm.Command(f"Version set to {words[0]}")
        return qtm.ErrorReply("Version NOT supported")

    def _stream_frames(self, client: QtmClient, words: list[str]) -> qtm.Message | None:
        client.kinds, client.udp, client.held = (), None, None
        if words[:1] == ["stop"]:
            return None
        for word in words:
            name, _, address = word.partition(":")
            if name == "udp":
                host, _, port = address.rpartition(":")
                client.udp = (host or client.wire.address[0], int(port))
        client.kinds = requested_components(words)
        if not client.kinds:
            return qtm.ErrorReply("Parse error")
        return None if self.measuring else qtm.NoMoreData()


def _udp_socket() -> socket.socket:
    """Return the UDP socket that sends frames."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    return opened
