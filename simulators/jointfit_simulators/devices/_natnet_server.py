"""Simulated NatNet server of Motive on the loopback interface.

Invariant: a unicast client receives the first frame after the reply to its REQUEST_MODELDEF, or 50
ms after CONNECT. The reason: one existing client treats the datagram after its request as the model
description.
"""

from __future__ import annotations

import asyncio
import random
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.natnet import (
    FRAME_BITSTREAM_CHANGED,
    FRAME_EDIT_MODE,
    FRAME_MODEL_CHANGED,
    HEADER,
    SIZED,
    TICKED,
    Bare,
    CommandRequest,
    CommandResponse,
    Connect,
    Discovery,
    EchoRequest,
    EchoResponse,
    Message,
    NatNetMessageId,
    ServerInfo,
    Version,
    decode,
    encode,
)
from jointfit_simulators.devices._natnet_frames import (
    FrameStamps,
    NatNetFrameBuilder,
    model_definition,
)
from jointfit_simulators.devices._natnet_options import NatNetServerOptions
from jointfit_simulators.devices._natnet_port import NatNetPort

if TYPE_CHECKING:
    from jointfit_protocols.natnet import FrameOfData
    from jointfit_simulators.devices._natnet_frames import Bodies, Markers, RigidBodyAsset
    from jointfit_simulators.devices._natnet_port import Address

_PATIENCE_NS = 50_000_000
"""Time after CONNECT at which frames begin without REQUEST_MODELDEF, ns."""
_ANNOUNCED_FRAMES = 10
"""Number of frames that announce a change. With several frames, the loss of one datagram has no
effect."""
_SELECTABLE: Version = (4, 0)
"""Lowest bitstream version that a unicast client can select."""
_NAME_FIELD = 256
"""Length of the application name in SERVERINFO, bytes."""
_I32_MAX = struct.pack("<i", 2**31 - 1)


@dataclass(slots=True)
class Client:
    """State of one unicast client or of the multicast group."""

    address: Address
    version: Version
    last_message_ns: int
    connected_ns: int
    described: bool = False
    changed: int = 0
    """Number of further frames that announce the new bitstream version."""
    sent: int = 0
    held: bytes | None = None
    """Frame that is sent after its successor (reordering)."""


class NatNetServer:
    """Simulated server. Its port is open from the start, and `run` answers requests.

    Attributes
    ----------
    ready : asyncio.Event
        Event that is set while `run` answers.
    edit_mode : bool
        Whether frames are flagged as playback of a recording.
    number : int
        Number of the next frame; tests can set it to simulate a jump.
    """

    def __init__(self, options: NatNetServerOptions | None = None) -> None:
        self.options = options or NatNetServerOptions()
        self._port = NatNetPort(self.options.command_port, self.options.data_port)
        self.command_port = self._port.command_port
        """UDP port for commands of clients."""
        self.data_port = self._port.data_port
        """UDP port of multicast frames."""

        self._builder = NatNetFrameBuilder(
            self.options.bodies, self.options.up_axis, self.options.hiding
        )
        self._random = random.Random(self.options.seed)  # noqa: S311 - the same draws in every run
        self._clients: dict[Address, Client] = {}
        group = (self.options.group, self._port.data_port)
        self._group = Client(group, self.options.bitstream, 0, 0, described=True)
        self._model_changed = 0
        self.ready = asyncio.Event()
        self.edit_mode = False
        self.number = 0
        self._sent_before = 0

    @property
    def clients(self) -> tuple[Client, ...]:
        """Connected unicast clients."""
        return tuple(self._clients.values())

    @property
    def sent(self) -> int:
        """Number of sent frames, summed over the clients; the multicast group is one client."""
        return self._sent_before + self._group.sent + sum(c.sent for c in self.clients)

    @property
    def bitstream(self) -> Version:
        """Bitstream version for clients that select no version."""
        return self._group.version

    async def run(self) -> None:
        """Answer requests until cancelled."""
        self.ready.set()
        try:
            await self._port.serve(self._handle)
        finally:
            self.ready.clear()

    def unplug(self) -> None:
        """Close the port and disconnect all clients, as when Motive is closed."""
        self._port.unplug()
        for client in self.clients:
            self._disconnect(client)

    def plug(self) -> None:
        """Open the same port again."""
        self._port.plug()

    def restart(self) -> None:
        """Close and reopen the server; frame numbers restart from 0."""
        self.unplug()
        self.plug()
        self.number = 0

    def set_bodies(self, bodies: tuple[RigidBodyAsset, ...]) -> None:
        """Replace the rigid bodies during the run; the next frames announce the change."""
        self._builder = NatNetFrameBuilder(bodies, self.options.up_axis, self.options.hiding)
        self._model_changed = _ANNOUNCED_FRAMES

    def set_bitstream(self, version: Version) -> None:
        """Change the bitstream version of all clients; the next frames announce the change."""
        for client in (*self.clients, self._group):
            client.version, client.changed = version, _ANNOUNCED_FRAMES

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
        frame = self._builder.frame(self._stamps(exposure_host_ns), markers, bodies)
        if self.options.precision_ns is not None:
            precision = divmod(self.options.precision_ns(exposure_host_ns), NS_PER_S)
            frame = frame._replace(precision=precision)
        self.number += 1
        self._model_changed = max(0, self._model_changed - 1)

        if self.options.transport == "multicast":
            self._send_frame(self._group, frame)
            return
        now_ns = time.monotonic_ns()
        for client in self.clients:
            if now_ns - client.last_message_ns > self.options.keepalive_s * NS_PER_S:
                self._send(Bare(NatNetMessageId.DISCONNECTBYTIMEOUT), client.address)
                self._disconnect(client)
            elif client.described or now_ns - client.connected_ns > _PATIENCE_NS:
                self._send_frame(client, frame)

    # --- frames -------------------------------------------------------------------------------

    def _ticks(self, host_ns: int) -> int:
        return self.options.device_ns(host_ns) * self.options.clock_hz // NS_PER_S

    def _stamps(self, exposure_ns: int) -> FrameStamps:
        options = self.options
        received = exposure_ns + options.received_after_ns
        params = FRAME_MODEL_CHANGED if self._model_changed else 0
        params |= FRAME_EDIT_MODE if self.edit_mode else 0

        return FrameStamps(
            self.number,
            self.number / options.rate_hz,
            self._ticks(exposure_ns) if options.exposure_stamps else 0,
            self._ticks(received),
            self._ticks(max(time.monotonic_ns(), received)),
            params,
        )

    def _send_frame(self, client: Client, frame: FrameOfData) -> None:
        if client.changed:
            client.changed -= 1
            frame = frame._replace(params=frame.params | FRAME_BITSTREAM_CHANGED)

        # Damage the frame on the wire.
        options, draw, data = self.options, self._random.random, encode(frame, client.version)
        if draw() < options.hostile:
            at = self._random.choice((2, 8, 12, 16, 20))
            data = data[:at] + _I32_MAX + data[at + 4 :]
        data = options.wire_noise(data)

        # Simulate loss, reordering and duplication on the network.
        if draw() < options.loss:
            return
        if client.held is None and draw() < options.reordering:
            client.held = data
            return
        copies = 2 if draw() < options.duplication else 1
        late, client.held = client.held, None
        for item in [data] * copies + ([late] if late is not None else []):
            if options.copy_to_data_port:
                self._port.send(item, (client.address[0], self.data_port))
            client.sent += self._port.send(item, client.address)

    # --- answers ------------------------------------------------------------------------------

    def _handle(self, data: bytes, address: Address) -> None:
        message = decode(data, self.options.bitstream)
        client = self._clients.get(address)
        if client is not None:
            client.last_message_ns = time.monotonic_ns()

        match message:
            case Discovery():
                self._send_info(address, self.bitstream)
            case Connect():
                self._connect(message, address)
            case EchoRequest(stamp):
                self._send(EchoResponse(stamp, self._ticks(time.monotonic_ns())), address)
            case CommandRequest(command):
                self._send(self._answer(command, client), address)
            case Bare(NatNetMessageId.REQUEST_MODELDEF):
                client = client or self._group
                model = model_definition(self._builder.bodies, client.version)
                self._send(model, address, client.version)
                client.described = True
            case Bare(NatNetMessageId.DISCONNECT) if client is not None:
                self._disconnect(client)
            case _:
                return

    def _send(self, message: Message, address: Address, version: Version = (3, 0)) -> None:
        self._port.send(encode(message, version), address)

    def _connect(self, connect: Connect, address: Address) -> None:
        now_ns = time.monotonic_ns()
        client = self._clients.get(address) or Client(address, self.bitstream, now_ns, now_ns)
        wanted = connect.bitstream[:2]
        if wanted >= _SELECTABLE and self._selectable:
            client.version = wanted
        if self.options.transport == "unicast":
            self._clients[address] = client
        self._send_info(address, client.version)

    @property
    def _selectable(self) -> bool:
        return self.options.transport == "unicast" and self.options.bitstream >= _SELECTABLE

    def _send_info(self, address: Address, version: Version) -> None:
        options = self.options
        info = ServerInfo(
            options.application, (3, 0, 0, 0), (*version, 0, 0),
            options.clock_hz if version >= TICKED else None,
            self.data_port, options.transport == "multicast", options.group,
        )  # fmt: skip
        data = bytearray(encode(info))

        # Like Motive, leave arbitrary bytes after the end of the name.
        begin = HEADER.size + len(options.application.encode()) + 1
        end = HEADER.size + _NAME_FIELD
        data[begin:end] = bytes(0xA5 ^ i & 0xFF for i in range(end - begin))
        self._port.send(bytes(data), address)

    def _answer(self, command: str, client: Client | None) -> Message:
        word, _, rest = command.partition(",")

        match word:
            case "FrameRate":
                return CommandResponse(struct.pack("<f", self.options.rate_hz))
            case "UnitsToMillimeters":
                return CommandResponse(struct.pack("<f", 1000.0))
            case "AnalogSamplesPerMocapFrame":
                return CommandResponse(bytes(4))
            case "Bitstream" if client is not None and self._selectable:
                if version := _selectable_version(rest):
                    client.version, client.changed = version, _ANNOUNCED_FRAMES
                    return CommandResponse(command.encode() + b"\0")
        return Bare(NatNetMessageId.UNRECOGNIZED_REQUEST)

    def _disconnect(self, client: Client) -> None:
        self._sent_before += client.sent
        self._clients.pop(client.address, None)


def _selectable_version(text: str) -> Version | None:
    """Return the version in a text ``MAJOR.MINOR`` if clients can select it, else None."""
    major, _, minor = text.partition(".")
    if not (major.isdecimal() and minor.isdecimal()):
        return None
    version = (int(major), int(minor))
    return version if _SELECTABLE <= version <= (SIZED[0], 2) else None
