"""Exchange of requests and replies with an Xbus device.

Bytes before the first acknowledgement are old or come from another device, and are discarded. From
the acknowledgement on, every byte is emitted once, so that the decoder also receives the device's
replies.

Source: MT0101P rev. 2020.A, state diagram, which defines a time-out of 500 ms.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.model import Chunk
from jointfit_protocols.xbus import MASTER, XbusCodec, XbusMessage, XbusMessageId, encode, mtdata2

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort

REPLY_S = 0.5
"""Longest wait for a reply, s."""
OUTSTANDING_S = 2.0
"""Longest wait for a reply to one GoToConfig while the device sends data, s. Some devices take 1.5
s, and further requests would only be queued after the first.
"""
_MOST_REPLY_S = 8.0
"""Longest wait for a reply of a slow device, s."""
_QUIET_S = 0.1
"""Pause after which the rest of a message with a corrupt length is no longer expected, s."""
_KNOWN = frozenset(map(int, XbusMessageId))
_OTHER_ADDRESS = 0x01
"""Second bus address that a stand-alone device may use in replies."""
_KEPT = 8192
"""Number of bytes stored before the acknowledgement. It exceeds one message of the largest length,
whose data may look like an acknowledgement by chance."""


class XbusConversation:
    """Exchange of requests and replies with one device on one port.

    Parameters
    ----------
    port : SerialPort
        Open port.
    emit : Emit
        Function that receives all bytes from the first acknowledgement of configuration mode on.
    """

    def __init__(self, port: SerialPort, emit: Emit) -> None:
        self._port = port
        self._emit = emit
        self._decoder = XbusCodec()
        self._emitting = False
        self._recent = b""
        self._t_ns = 0
        self.received = 0
        """Number of bytes received so far."""
        self.reply_s = REPLY_S
        """Current wait for a reply, s. It is longer for a device that acknowledged late."""
        self.understood = 0
        """Number of received messages that only an Xbus device sends. Other messages may be noise
        that passed the checksum."""

    def reset(self) -> None:
        """Discard the bytes received so far, for example before another speed is used."""
        self._port.flush_input()
        self._decoder, self._recent = XbusCodec(), b""
        self.received = self.understood = 0

    async def send(self, mid: int, data: bytes = b"") -> None:
        """Send one message."""
        await self._port.write(encode(mid, data))

    async def request(self, mid: int, data: bytes = b"", *, tries: int = 2) -> XbusMessage | None:
        """Send a request until its reply or an error arrives; return None if neither arrives."""
        for _ in range(tries):
            await self.send(mid, data)
            reply = await self.receive({mid + 1, XbusMessageId.ERROR}, self.reply_s)

            if reply is not None:
                return reply
        return None

    async def enter_config(
        self,
        *,
        tries: int = 3,
        wait_s: float = REPLY_S,
        late_s: float = 0.0,
        late_if_silent: bool = False,
    ) -> bool:
        """Send GoToConfig until it is acknowledged. After that, all bytes are emitted.

        Parameters
        ----------
        tries : int
            Largest number of requests.
        wait_s : float
            Interval between requests while the device sends nothing, s.
        late_s : float
            Wait for an acknowledgement in addition to ``tries * wait_s`` if the device sends data,
            s. If this wait is positive and the device sends data, only one request is pending at a
            time, at intervals of `OUTSTANDING_S`.
        late_if_silent : bool
            Whether to wait `late_s` also if the device sends nothing.

        Returns
        -------
        bool
            Whether the device acknowledged.
        """
        loop = asyncio.get_running_loop()
        began = asked = loop.time()
        sent = before = 0
        wanted = {XbusMessageId.GOTO_CONFIG_ACK, XbusMessageId.WAKE_UP}
        start = self.received

        while True:
            now = loop.time()
            late = late_s if late_if_silent or self.received > start else 0.0
            if now >= began + tries * wait_s + late:
                return False

            waits = late_s > 0 and self.received > before and now < asked + OUTSTANDING_S
            if sent == 0 or (sent < tries and not waits):
                asked, before, sent = now, self.received, sent + 1
                await self.send(XbusMessageId.GOTO_CONFIG)

            reply = await self.receive(wanted, wait_s)
            if reply is not None and reply.mid == XbusMessageId.WAKE_UP:
                # The device has just started, and waits for this answer.
                await self.send(XbusMessageId.WAKE_UP_ACK)
                await self.send(XbusMessageId.GOTO_CONFIG)
                reply = await self.receive({XbusMessageId.GOTO_CONFIG_ACK}, wait_s)
            if reply is not None:
                took = loop.time() - began
                # Replies to earlier requests may still arrive. They arrive in the order of the
                # requests.
                if took > wait_s and late_s:
                    self.reply_s = min((sent + 1) * took, _MOST_REPLY_S)
                return True

    async def receive(self, mids: Collection[int], wait_s: float) -> XbusMessage | None:
        """Return the first message with one of `mids`; None after `wait_s` seconds."""
        loop = asyncio.get_running_loop()
        until = loop.time() + wait_s
        while (left := until - loop.time()) > 0:
            chunk = await self._port.receive(min(left, _QUIET_S))
            if chunk is None:
                found = self._decoder.flush() if self._decoder.pending else []
            else:
                self.received += len(chunk.data)
                if self._emitting:
                    self._emit(chunk)
                else:
                    self._t_ns = chunk.t_ns
                    self._recent = (self._recent + chunk.data)[-_KEPT:]
                found = self._decoder.feed(chunk.data)

            messages = [event for event in found if isinstance(event, XbusMessage)]
            self.understood += sum(map(_is_certain, messages))
            for message in messages:
                if message.mid not in mids or not _is_certain(message):
                    continue

                # From the acknowledgement of configuration mode on, all bytes are emitted.
                if message.mid == XbusMessageId.GOTO_CONFIG_ACK and not self._emitting:
                    after = self._decoder.fed - message.end
                    rest = self._recent[len(self._recent) - after :]
                    self._emitting, self._recent = True, b""
                    wire = encode(message.mid, message.data, message.bid)
                    self._emit(Chunk(self._t_ns, wire + rest))
                return message
        return None


def _is_certain(message: XbusMessage) -> bool:
    """Return whether a message with a valid checksum certainly comes from an Xbus device."""
    if message.bid not in {MASTER, _OTHER_ADDRESS} or message.mid not in _KNOWN:
        return False
    return message.mid != XbusMessageId.MT_DATA2 or bool(mtdata2.split(message.data))
