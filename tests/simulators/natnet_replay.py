"""NatNet server that replays a capture. Invariant: frames are sent as the recorded bytes.

The handshake returns the recorded name, version, clock frequency and model, but in unicast and with
this server's own ports. Frames are sent at the recorded intervals once a client has received the
model. Echo requests are answered with the recorded clock, continued.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

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
from jointfit_simulators.devices._natnet_port import NatNetPort

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_simulators.devices._natnet_port import Address

_NS = 10**9


class NatNetReplay:
    """Server that sends the datagrams of a capture to one client.

    Parameters
    ----------
    datagrams : iterable of (int, bytes)
        Arrival, ns, and content, in order; SERVERINFO, MODELDEF and frames are used.
    """

    def __init__(self, datagrams: Iterable[tuple[int, bytes]]) -> None:
        info: ServerInfo | None = None
        model: bytes | None = None
        self._frames: list[tuple[int, bytes]] = []
        self._ticks = 0
        for t_ns, data in datagrams:
            message = decode(data, info.bitstream if info is not None else (0, 0))
            if isinstance(message, ServerInfo):
                info = message
            elif isinstance(message, ModelDefinition):
                model = data
            elif isinstance(message, FrameOfData):
                self._ticks = self._ticks or message.transmit
                self._frames.append((t_ns, data))
        assert info is not None, "no SERVERINFO"
        assert model is not None, "no MODELDEF"
        assert self._frames, "no frames"
        self._info, self._model = info, model

        self._port = NatNetPort()
        self._client: Address | None = None
        self._ready = asyncio.Event()
        self._began_ns = 0
        self.sent = 0
        """Number of frames sent."""

    @property
    def command_port(self) -> int:
        """UDP port for commands of clients."""
        return self._port.command_port

    @property
    def frames(self) -> int:
        """Number of frames in the capture."""
        return len(self._frames)

    def unplug(self) -> None:
        """Close the socket."""
        self._port.unplug()

    async def run(self) -> None:
        """Answer until cancelled; send the frames once the first client has the model."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._port.serve(self._handle), name="natnet replay answers")
            await self._ready.wait()

            first_ns, loop = self._frames[0][0], asyncio.get_running_loop()
            began = loop.time()
            for t_ns, data in self._frames:
                await asyncio.sleep(began + (t_ns - first_ns) / _NS - loop.time())
                if self._client is not None:
                    self.sent += self._port.send(data, self._client)

    def _handle(self, data: bytes, address: Address) -> None:
        message = decode(data, self._info.bitstream)
        self._began_ns = self._began_ns or time.monotonic_ns()
        match message:
            case Connect() | Discovery():
                own = self._info._replace(data_port=self._port.data_port, multicast=False)
                self._port.send(encode(own), address)
            case EchoRequest(stamp):
                since_ns = time.monotonic_ns() - self._began_ns
                ticks = self._ticks + since_ns * (self._info.clock_hz or 0) // _NS
                self._port.send(encode(EchoResponse(stamp, ticks)), address)
            case Bare(NatNetMessageId.REQUEST_MODELDEF):
                self._port.send(self._model, address)
                self._client = address
                self._ready.set()
            case _:
                return
