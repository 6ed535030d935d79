"""Exchange of requests and replies with a device on a serial line.

Bytes before the first reply are old or come from another device, and are discarded. From the first
reply on, every byte is emitted once, so that the decoder also receives the device's replies.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from jointfit_daemon.model import Chunk
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort

log = logging.getLogger(__name__)

_QUIET_S = 0.1
"""Pause after which the rest of a message with a corrupt length is no longer expected, s."""
_KEPT = 8192
"""Largest number of bytes stored before the first reply. This number exceeds the size of one
message plus the data that arrive together with it."""
_LOGGED = 20
"""Number of chunks logged at debug level, so that the log contains raw data of a new device."""


class WireMessage(Protocol):
    """Interface of the messages that a codec returns."""

    @property
    def size(self) -> int:
        """Length of the message on the wire, bytes."""

    @property
    def end(self) -> int:
        """Number of bytes fed to the codec until the end of the message."""


Message = TypeVar("Message", bound=WireMessage)
Found_co = TypeVar("Found_co", bound=WireMessage, covariant=True)


class StreamCodec(Protocol[Found_co]):
    """Interface of a codec for a byte stream."""

    fed: int

    @property
    def pending(self) -> int:
        """Number of buffered bytes, which belong to an incomplete message."""

    def feed(self, data: bytes) -> Sequence[Found_co | CorruptBytes]:
        """Return the messages and runs of corrupt bytes that `data` completes."""

    def flush(self) -> Sequence[Found_co | CorruptBytes]:
        """Discard the incomplete message; return other messages that the pending bytes contain."""


class SerialConversation(Generic[Message]):
    """Exchange of requests and replies with one device on one port.

    Parameters
    ----------
    port : SerialPort
        Open port.
    emit : Emit
        Function that receives all bytes from the first reply on.
    make_codec : callable
        Function that returns a new codec.
    """

    def __init__(
        self, port: SerialPort, emit: Emit, make_codec: Callable[[], StreamCodec[Message]]
    ) -> None:
        self._port, self._emit, self._make_codec = port, emit, make_codec
        self._codec = make_codec()
        self._emitting = False
        self._recent = b""
        self._t_ns = 0  # arrival of the last chunk
        self._logged = 0
        self.received = 0
        """Number of bytes received since the last reset."""
        self.understood = 0
        """Number of messages received since the last reset."""

    def reset(self) -> None:
        """Discard received bytes, here and in the port, before a change of speed or a new start."""
        self._port.flush_input()
        self._codec, self._recent = self._make_codec(), b""
        self.received = self.understood = 0

    async def send(self, request: bytes) -> None:
        """Send one request."""
        await self._port.write(request)

    async def ask(
        self, request: bytes, is_reply: Callable[[Message], bool], *, tries: int, wait_s: float
    ) -> Message | None:
        """Send a request up to `tries` times, and return the first reply.

        Wait at most `wait_s` seconds after each request. Return None if no reply arrives.
        """
        for _ in range(tries):
            await self.send(request)
            reply = await self.receive(is_reply, wait_s)
            if reply is not None:
                return reply
        return None

    async def receive(self, is_reply: Callable[[Message], bool], wait_s: float) -> Message | None:
        """Return the first message that `is_reply` accepts; None after `wait_s` seconds."""
        loop = asyncio.get_running_loop()
        until = loop.time() + wait_s
        while (left := until - loop.time()) > 0:
            chunk = await self._port.receive(min(left, _QUIET_S))
            if chunk is None:
                found = self._codec.flush() if self._codec.pending else []
            else:
                found = self._take(chunk)

            messages = [one for one in found if not isinstance(one, CorruptBytes)]
            self.understood += len(messages)
            for message in messages:
                if is_reply(message):
                    if not self._emitting:  # emit the reply and all later bytes
                        since = self._codec.fed - message.end + message.size
                        data, self._recent = self._recent[-since:], b""
                        self._emitting = True
                        self._emit(Chunk(self._t_ns, data))
                    return message
        return None

    def _take(self, chunk: Chunk) -> Sequence[Message | CorruptBytes]:
        self._t_ns = chunk.t_ns
        self.received += len(chunk.data)
        if self._logged < _LOGGED:
            self._logged += 1
            log.debug("%s: received %s", self._port.path, chunk.data.hex(" "))
        if self._emitting:
            self._emit(chunk)
        else:
            self._recent = (self._recent + chunk.data)[-_KEPT:]
        return self._codec.feed(chunk.data)
