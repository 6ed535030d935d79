"""NatNet server that replays a capture. Invariant: frames are sent as the recorded bytes.

The handshake returns the recorded name, version, clock frequency and model, but in unicast and with
this server's own ports. Frames are sent at the recorded intervals once a client has received the
model. Echo requests are answered with the recorded clock, continued.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, NamedTuple

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

    from jointfit_protocols.natnet import Version
    from jointfit_simulators.devices._natnet_port import Address

_NS = 10**9
_UNTOLD: Version = (0, 0)


class _Recorded(NamedTuple):
    t_ns: int
    data: bytes


class NatNetReplay:
    """Plays the datagrams of a capture to one client.

    Parameters
    ----------
    datagrams : iterable of (int, bytes)
        Arrival, ns, and content, in order; SERVERINFO, MODELDEF and frames are used.
    speed : float
        2.0 plays twice as fast; stamps inside the frames stay as recorded.

    Raises
    ------
    ValueError
        The capture holds no SERVERINFO, no MODELDEF or no frame.
    """

    def __init__(self, datagrams: Iterable[tuple[int, bytes]], *, speed: float = 1.0) -> None:
        info: ServerInfo | None = None
        model: bytes | None = None
        self._frames: list[_Recorded] = []
        self._ticks = 0
        for t_ns, data in datagrams:
            message = decode(data, info.bitstream if info is not None else _UNTOLD)
            if isinstance(message, ServerInfo):
                info = message
            elif isinstance(message, ModelDefinition):
                model = data
            elif isinstance(message, FrameOfData):
                self._ticks = self._ticks or message.transmit
                self._frames.append(_Recorded(t_ns, data))
        if info is None or model is None or not self._frames:
            raise ValueError("a capture with SERVERINFO, MODELDEF and frames is needed")
        self._info, self._model, self._speed = info, model, speed
        self._port = NatNetPort()
        self._client: Address | None = None
        self._ready = asyncio.Event()
        self._began_ns = 0
        self.sent = 0
        """Frames put on the wire."""

    @property
    def command_port(self) -> int:
        """Where CONNECT goes."""
        return self._port.command_port

    @property
    def frames(self) -> int:
        """Frames in the capture."""
        return len(self._frames)

    def unplug(self) -> None:
        """Close the socket."""
        self._port.unplug()

    async def run(self) -> None:
        """Answer until cancelled; play once, when the first client has its model."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._port.serve(self._handle), name="natnet replay answers")
            await self._ready.wait()
            await self._play()

    async def _play(self) -> None:
        first_ns, loop = self._frames[0].t_ns, asyncio.get_running_loop()
        began = loop.time()
        for t_ns, data in self._frames:
            await asyncio.sleep(began + (t_ns - first_ns) / _NS / self._speed - loop.time())
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
                self._port.send(encode(EchoResponse(stamp, self._now_ticks())), address)
            case Bare(NatNetMessageId.REQUEST_MODELDEF):
                self._port.send(self._model, address)
                self._client = address
                self._ready.set()
            case _:
                return

    def _now_ticks(self) -> int:
        since_ns = time.monotonic_ns() - self._began_ns
        return self._ticks + since_ns * (self._info.clock_hz or 0) // _NS
