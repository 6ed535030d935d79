"""Simulated NatNet server on loopback with the behaviour of Motive.

Invariant: a unicast client receives frames only after the reply to its REQUEST_MODELDEF or 50 ms
after CONNECT, because one existing client parses the next datagram as the model description.
"""

from __future__ import annotations

import asyncio
import random
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_protocols.natnet import (
    FRAME_BITSTREAM_CHANGED,
    FRAME_EDIT_MODE,
    FRAME_MODEL_CHANGED,
    HEADER,
    SIZED,
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

_NS = 10**9
_PATIENCE_NS = 50_000_000
_ANNOUNCED_FRAMES = 10
"""A change is announced in this many frames, so that one lost datagram does not hide it."""
_SELECTABLE: Version = (4, 0)
"""From this bitstream on a unicast client may choose."""
_NAME_FIELD = 256
_I32_MAX = struct.pack("<i", 2**31 - 1)


@dataclass(slots=True)
class Client:
    """One unicast client, or whoever listens to the group."""

    address: Address
    version: Version
    heard_ns: int
    since_ns: int
    described: bool = False
    changed: int = 0
    """Frames yet to announce its new bitstream."""
    sent: int = 0
    held: bytes | None = None
    """A frame that waits for its successor (reordering)."""


class NatNetServer:
    """A server that is plugged in when made; `run` makes it answer.

    Attributes
    ----------
    ready : asyncio.Event
        Set once `run` answers.
    edit_mode : bool
        Frames say that they are played from a recording.
    number : int
        Number of the next frame; may be set, to jump.
    """

    def __init__(self, options: NatNetServerOptions | None = None) -> None:
        self.options = options or NatNetServerOptions()
        self._port = NatNetPort(self.options.command_port, self.options.data_port)
        self._stage = NatNetFrameBuilder(
            self.options.bodies, self.options.up_axis, self.options.hiding
        )
        self._random = random.Random(self.options.seed)  # noqa: S311 - the same dice every time
        self._clients: dict[Address, Client] = {}
        group = (self.options.group, self._port.data_port)
        self._listeners = Client(group, self.options.bitstream, 0, 0, described=True)
        self._model_changed = 0
        self.ready = asyncio.Event()
        self.edit_mode = False
        self.number = 0
        self._sent_before = 0

    @property
    def command_port(self) -> int:
        """Where CONNECT goes."""
        return self._port.command_port

    @property
    def data_port(self) -> int:
        """Where multicast frames go."""
        return self._port.data_port

    @property
    def clients(self) -> tuple[Client, ...]:
        """Unicast clients at present."""
        return tuple(self._clients.values())

    @property
    def sent(self) -> int:
        """Frames put on the wire, summed over clients (multicast counts as one)."""
        return self._sent_before + self._listeners.sent + sum(c.sent for c in self.clients)

    @property
    def bitstream(self) -> Version:
        """What a client gets that does not choose."""
        return self._listeners.version

    async def run(self) -> None:
        """Answer until cancelled."""
        self.ready.set()
        try:
            await self._port.serve(self._handle)
        finally:
            self.ready.clear()

    def unplug(self) -> None:
        """Stop being there; clients are forgotten, as when Motive is closed."""
        self._port.unplug()
        for client in self.clients:
            self._forget(client)

    def plug(self) -> None:
        """Be there again, at the same port."""
        self._port.plug()

    def restart(self) -> None:
        """Close and open: clients forgotten, frame numbers from 0."""
        self.unplug()
        self.plug()
        self.number = 0

    def set_bodies(self, bodies: tuple[RigidBodyAsset, ...]) -> None:
        """Change the operator's project while running; the next frames announce it."""
        self._stage = NatNetFrameBuilder(bodies, self.options.up_axis, self.options.hiding)
        self._model_changed = _ANNOUNCED_FRAMES

    def set_bitstream(self, version: Version) -> None:
        """Change the bitstream for everybody; the next frames announce it."""
        for client in (*self.clients, self._listeners):
            client.version, client.changed = version, _ANNOUNCED_FRAMES

    def push(self, exposure_host_ns: int, markers: Markers, bodies: Bodies) -> None:
        """Send one frame now.

        Parameters
        ----------
        exposure_host_ns : int
            When the cameras exposed it, host CLOCK_MONOTONIC, however late it leaves.
        markers : mapping of str to (x, y, z) or None
            World z up, m; None is hidden. Those of no body are sent as unlabeled.
        bodies : mapping of str to (position, quaternion) or None
            World z up, m, q_world_body (w, x, y, z); None is not tracked.
        """
        stamps = self._stamps(exposure_host_ns)
        frame = self._stage.frame(stamps, markers, bodies)
        if self.options.precision_ns is not None:
            told = divmod(self.options.precision_ns(exposure_host_ns), _NS)
            frame = frame._replace(precision=told)
        self.number += 1
        self._model_changed = max(0, self._model_changed - 1)
        if self.options.transport == "multicast":
            self._send_frame(self._listeners, frame)
            return
        now_ns = time.monotonic_ns()
        for client in self.clients:
            if now_ns - client.heard_ns > self.options.keepalive_s * _NS:
                self._send(Bare(NatNetMessageId.DISCONNECTBYTIMEOUT), client.address)
                self._forget(client)
            elif client.described or now_ns - client.since_ns > _PATIENCE_NS:
                self._send_frame(client, frame)

    # --- frames -------------------------------------------------------------------------------

    def _ticks(self, host_ns: int) -> int:
        return self.options.device_ns(host_ns) * self.options.clock_hz // _NS

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
        data = self.options.wire_noise(self._hostile(encode(frame, client.version)))
        dice, options = self._random.random, self.options
        if dice() < options.loss:
            return
        if client.held is None and dice() < options.reordering:
            client.held = data
            return
        copies = 2 if dice() < options.duplication else 1
        late, client.held = client.held, None
        for item in [data] * copies + ([late] if late is not None else []):
            client.sent += self._put(item, client)

    def _put(self, data: bytes, client: Client) -> bool:
        if self.options.copy_to_data_port:
            self._port.send(data, (client.address[0], self.data_port))
        return self._port.send(data, client.address)

    def _hostile(self, data: bytes) -> bytes:
        if self._random.random() >= self.options.hostile:
            return data
        at = self._random.choice((2, 8, 12, 16, 20))
        return data[:at] + _I32_MAX + data[at + 4 :]

    # --- answers ------------------------------------------------------------------------------

    def _handle(self, data: bytes, address: Address) -> None:
        message = decode(data, self.options.bitstream)
        client = self._clients.get(address)
        if client is not None:
            client.heard_ns = time.monotonic_ns()
        match message:
            case Discovery():
                self._put_info(address, self.bitstream)
            case Connect():
                self._connect(message, address)
            case EchoRequest(stamp):
                self._send(EchoResponse(stamp, self._ticks(time.monotonic_ns())), address)
            case CommandRequest(command):
                self._send(self._answer(command, client), address)
            case Bare(NatNetMessageId.REQUEST_MODELDEF):
                self._describe(client or self._listeners, address)
            case Bare(NatNetMessageId.DISCONNECT) if client is not None:
                self._forget(client)
            case _:
                return

    def _send(self, message: Message, address: Address, version: Version = (3, 0)) -> None:
        self._port.send(encode(message, version), address)

    def _connect(self, connect: Connect, address: Address) -> None:
        now_ns = time.monotonic_ns()
        wanted = connect.bitstream[:2]
        client = self._clients.get(address) or Client(address, self.bitstream, now_ns, now_ns)
        if wanted != (0, 0) and self._selectable and wanted >= _SELECTABLE:
            client.version = wanted
        if self.options.transport == "unicast":
            self._clients[address] = client
        self._put_info(address, client.version)

    @property
    def _selectable(self) -> bool:
        return self.options.transport == "unicast" and self.options.bitstream >= _SELECTABLE

    def _put_info(self, address: Address, version: Version) -> None:
        options = self.options
        info = ServerInfo(
            options.application, (3, 0, 0, 0), (*version, 0, 0), options.clock_hz,
            self.data_port, options.transport == "multicast", options.group,
        )  # fmt: skip
        data = bytearray(encode(info))
        begin = HEADER.size + len(options.application.encode()) + 1
        end = HEADER.size + _NAME_FIELD
        data[begin:end] = bytes(0xA5 ^ i & 0xFF for i in range(end - begin))  # stale memory
        self._port.send(bytes(data), address)

    def _answer(self, command: str, client: Client | None) -> Message:
        word, _, rest = command.partition(",")
        if word == "FrameRate":
            return CommandResponse(struct.pack("<f", self.options.rate_hz))
        if word == "UnitsToMillimeters":
            return CommandResponse(struct.pack("<f", 1000.0))
        if word == "AnalogSamplesPerMocapFrame":
            return CommandResponse(bytes(4))
        version = _version(rest)
        if word == "Bitstream" and client is not None and version and self._selectable:
            client.version, client.changed = version, _ANNOUNCED_FRAMES
            return CommandResponse(command.encode() + b"\0")
        return Bare(NatNetMessageId.UNRECOGNIZED_REQUEST)

    def _describe(self, client: Client, address: Address) -> None:
        model = model_definition(self._stage.bodies, client.version)
        self._send(model, address, client.version)
        client.described = True

    def _forget(self, client: Client) -> None:
        self._sent_before += client.sent
        self._clients.pop(client.address, None)


def _version(text: str) -> Version | None:
    major, _, minor = text.partition(".")
    if not (major.isdecimal() and minor.isdecimal()):
        return None
    version = (int(major), int(minor))
    return version if _SELECTABLE <= version <= (SIZED[0], 2) else None
