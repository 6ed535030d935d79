"""Commands to an x-IMU3 and its replies, while all its bytes are passed on to the daemon.

Bytes before the first reply are old or foreign and are discarded. From that reply on, every byte
is emitted once, so that the decoder also receives the settings in the replies. A device sends
measurements all the time; no command stops them.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.model import Chunk
from jointfit_protocols.ximu3 import XImu3Codec, XImu3Data, XImu3Reply, encode_command

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort

REPLY_S = 0.5
"""Longest wait for a reply, s: the time-out of the vendor's software."""
TRIES = 3
"""Number of times that a command is sent: the vendor's software retries twice."""
_CERTAIN = 3
"""Data messages that identify the protocol: a line of noise may have the form of one."""


class XImu3Conversation:
    """Commands and replies of one device on one port.

    Parameters
    ----------
    port : SerialPort
        Open port.
    emit : Emit
        Receives all bytes from the first reply on.
    """

    def __init__(self, port: SerialPort, emit: Emit) -> None:
        self._port = port
        self._emit = emit
        self._codec = XImu3Codec()
        self._emitting = False
        self._recent = b""
        self.received = 0
        """Bytes received so far."""
        self.data_messages = 0
        """Data messages received so far."""

    @property
    def understood(self) -> bool:
        """Whether the bytes received so far are certainly those of an x-IMU3."""
        return self._emitting or self.data_messages >= _CERTAIN

    def reset(self) -> None:
        """Discard received bytes, here and in the port: for another speed or a new start."""
        self._port.flush_input()
        self._codec, self._recent = XImu3Codec(), b""
        self.received = self.data_messages = 0

    async def request(
        self, key: str, value: object = None, *, tries: int = TRIES, wait_s: float = REPLY_S
    ) -> XImu3Reply | None:
        """Send a command until its reply arrives; return None if none does."""
        for _ in range(tries):
            await self._port.write(encode_command(key, value))
            reply = await self._receive(key, wait_s)
            if reply is not None:
                return reply
        return None

    async def _receive(self, key: str, wait_s: float) -> XImu3Reply | None:
        """Return the first reply with `key`, or None after `wait_s` seconds."""
        loop = asyncio.get_running_loop()
        until = loop.time() + wait_s
        while (left := until - loop.time()) > 0:
            chunk = await self._port.receive(left)
            if chunk is None:
                return None
            reply = self._take(chunk, key)
            if reply is not None:
                return reply
        return None

    def _take(self, chunk: Chunk, key: str) -> XImu3Reply | None:
        """Decode a chunk; emit it, from the first reply with `key` on."""
        self.received += len(chunk.data)
        if self._emitting:
            self._emit(chunk)
        else:
            self._recent = self._recent[-self._codec.pending :] if self._codec.pending else b""
            self._recent += chunk.data

        found: XImu3Reply | None = None
        for message in self._codec.feed(chunk.data):
            self.data_messages += isinstance(message, XImu3Data)
            if found is None and isinstance(message, XImu3Reply) and message.key == key:
                found = message
        if found is not None and not self._emitting:
            after = self._codec.fed - found.end + found.size
            self._emitting = True
            self._emit(Chunk(chunk.t_ns, self._recent[len(self._recent) - after :]))
            self._recent = b""
        return found
