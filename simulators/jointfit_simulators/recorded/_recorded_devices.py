"""Virtual devices that send the bytes of a recording.

Invariant: measurements are sent as recorded bytes. The answers to the configuration are simulated,
because the host sends its requests again.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.can import CanFrame, unpack_frames
from jointfit_protocols.natnet import (
    Bare,
    Connect,
    Discovery,
    EchoRequest,
    EchoResponse,
    FrameOfData,
    ModelDefinition,
    NatNetMessageId,
    ServerInfo,
    decode,
    encode,
)
from jointfit_protocols.xbus import XbusCodec, XbusMessage, XbusMessageId
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus import encode as encode_xbus
from jointfit_simulators.devices import NatNetPort, XbusDevice, XbusDeviceOptions
from jointfit_simulators.recorded._session_file import UnplayableRecordingError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from jointfit_simulators.devices import Address
    from jointfit_simulators.wires import CanWire


class RecordedXbusDevice(XbusDevice):
    """Xbus device with the recorded configuration; `send` transmits recorded measurements.

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    chunks
        Recorded chunks of the device, each with its time, ns.
    """

    def __init__(self, link: Path, chunks: Sequence[tuple[int, bytes]]) -> None:
        codec = XbusCodec()
        self.chunks: list[tuple[int, bytes]] = []
        """Bytes of measurements, each with its time, ns."""
        options = XbusDeviceOptions()
        for t_ns, data in chunks:
            messages = [item for item in codec.feed(data) if isinstance(item, XbusMessage)]
            answers = [one for one in messages if one.mid != XbusMessageId.MT_DATA2]
            for answer in answers:
                options = _with_settings(options, answer)
            measurements = data
            if answers:  # the chunk is part of the handshake
                measurements = b"".join(
                    encode_xbus(one.mid, one.data, one.bid)
                    for one in messages
                    if one.mid == XbusMessageId.MT_DATA2
                )
            if measurements:
                self.chunks.append((t_ns, measurements))
        super().__init__(link, options=options)

    @property
    def ready(self) -> bool:
        """Whether the host has started the measurement."""
        return self.streaming

    def send(self, data: bytes) -> None:
        """Send recorded bytes in measurement mode."""
        if self.streaming:
            self.sent += self._line.write(data)


def _with_settings(options: XbusDeviceOptions, answer: XbusMessage) -> XbusDeviceOptions:
    """Return the options with the setting that a recorded answer of the device contains."""
    match answer.mid:
        case XbusMessageId.DEVICE_ID:
            return replace(options, device_id=answer.data)
        case XbusMessageId.PRODUCT_CODE:
            return replace(options, product_code=setup.decode_text(answer.data))
        case XbusMessageId.FILTER_PROFILE_ACK:
            return replace(options, filter_profile=answer.data)
        case XbusMessageId.OUTPUT_CONFIGURATION_ACK:
            outputs = setup.decode_outputs(answer.data)
            if outputs:
                return replace(options, outputs=tuple((o.data_id, o.rate) for o in outputs))
    return options


class RecordedCanSource:
    """Sender of the recorded frames of one sensor on a CAN bus.

    Parameters
    ----------
    wire
        CAN bus, which several sensors share.
    chunks
        Recorded chunks of the sensor, each with its time, ns.
    """

    def __init__(self, wire: CanWire, chunks: Sequence[tuple[int, bytes]]) -> None:
        self.wire, self.chunks = wire, list(chunks)
        self.sent = 0
        """Number of sent chunks."""

    @property
    def ready(self) -> bool:
        """Whether the host has opened the bus."""
        return self.wire.is_open

    def send(self, data: bytes) -> None:
        """Send the frames of a chunk, except error frames and the host's notes on lost frames."""
        frames = [one for one in unpack_frames(data) if isinstance(one, CanFrame) and not one.error]
        self.sent += self.wire.send(frames)

    def unplug(self) -> None:
        """Disconnect the bus."""
        self.wire.unplug()

    async def run(self) -> None:
        """Serve the bus until cancelled."""
        await self.wire.run()


class RecordedCameras:
    """NatNet server that sends recorded datagrams in unicast on the loopback interface.

    The server answers with the recorded name, version, clock frequency and model. Its clock
    continues the recorded clock. Answers to EchoRequest messages contain the time of this clock.

    Parameters
    ----------
    chunks
        Recorded datagrams, each with its time, ns.
    command_port
        UDP port for commands of clients; 0 selects a free port.

    Raises
    ------
    UnplayableRecordingError
        The recording does not contain the description of the server or of the model.
    """

    def __init__(self, chunks: Iterable[tuple[int, bytes]], command_port: int = 0) -> None:
        info: ServerInfo | None = None
        model: bytes | None = None
        self.chunks: list[tuple[int, bytes]] = []
        """Recorded frames, each with its time, ns."""
        self._ticks_at: tuple[int, int] | None = None
        for t_ns, data in chunks:
            message = decode(data, info.bitstream if info is not None else (0, 0))
            match message:
                case ServerInfo():
                    info = message
                case ModelDefinition():
                    model = model or data
                case FrameOfData(transmit=transmit):
                    self._ticks_at = self._ticks_at or (t_ns, transmit or 0)
                    self.chunks.append((t_ns, data))
        if info is None or model is None:
            raise UnplayableRecordingError(
                "mocap: the recording begins after the connection to the camera server: the "
                "description of the server is missing. Choose a recording that began with the "
                "daemon"
            )
        self._info, self._model = info, model
        self._port = NatNetPort(command_port)
        self._client: Address | None = None
        self._began_ns: int | None = None
        self.sent = 0
        """Number of sent frames."""

    @property
    def command_port(self) -> int:
        """UDP port for commands of clients."""
        return self._port.command_port

    @property
    def ready(self) -> bool:
        """Whether a client has received the model."""
        return self._client is not None

    def begin(self, now_ns: int) -> None:
        """Set the host time at which the playback starts, ns; the recorded clock then continues."""
        self._began_ns = now_ns

    def send(self, data: bytes) -> None:
        """Send one frame to the client."""
        if self._client is not None:
            self.sent += self._port.send(data, self._client)

    def unplug(self) -> None:
        """Close the socket."""
        self._port.unplug()

    async def run(self) -> None:
        """Answer requests until cancelled."""
        await self._port.serve(self._handle)

    def _ticks(self) -> int:
        """Return the current value of the recorded clock, ticks."""
        first_ns, ticks = self._ticks_at or (0, 0)
        now_ns = time.monotonic_ns()
        since_ns = now_ns - (self._began_ns if self._began_ns is not None else now_ns) - first_ns
        return max(0, ticks + since_ns * (self._info.clock_hz or 0) // NS_PER_S)

    def _handle(self, data: bytes, address: Address) -> None:
        match decode(data, self._info.bitstream):
            case Connect() | Discovery():
                own = self._info._replace(data_port=self._port.data_port, multicast=False)
                self._port.send(encode(own), address)
            case EchoRequest(stamp):
                if self._began_ns is not None:  # the recorded clock is then defined
                    self._port.send(encode(EchoResponse(stamp, self._ticks())), address)
            case Bare(NatNetMessageId.REQUEST_MODELDEF):
                self._port.send(self._model, address)
                self._client = address
            case _:
                return
