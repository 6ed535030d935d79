"""Requests to an Xbus device and its replies, while all its bytes are passed on to the daemon.

Bytes before the first acknowledgement are old or foreign and are discarded. From the
acknowledgement on, every byte is emitted once, so that the decoder also receives the device's
replies.

Source: MT0101P rev. 2020.A, state diagram; the 500 ms are its time-outs.
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
"""Longest wait for a reply to one GoToConfig while the device is sending data, s. Some devices take
1.5 s, and further requests would queue behind the first.
"""
_MOST_REPLY_S = 8.0
"""Upper limit of the wait for a reply of a slow device, s."""
_QUIET_S = 0.1
"""Pause, s, after which the rest of a message with a corrupt length is no longer expected."""
_KNOWN = frozenset(map(int, XbusMessageId))
_OTHER_ADDRESS = 0x01
"""Bus address that a stand-alone device also uses in replies."""
_KEPT = 8192
"""Bytes stored before the acknowledgement; more than one message of greatest length, whose data may
contain the same bytes by chance."""


class XbusConversation:
    """Requests and replies of one device on one port.

    Parameters
    ----------
    port : SerialPort
        Open port.
    emit : Emit
        Receives all bytes from the first acknowledgement of configuration mode on.
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
        """Wait for a reply, s; longer for a device that acknowledged late."""
        self.understood = 0
        """Messages so far that only an Xbus device sends: noise may pass a checksum."""

    def reset(self) -> None:
        """Discard received bytes, here and in the port: for another speed or a new start."""
        self._port.flush_input()
        self._decoder, self._recent = XbusCodec(), b""
        self.received = self.understood = 0

    async def send(self, mid: int, data: bytes = b"") -> None:
        """Send one message."""
        await self._port.write(encode(mid, data))

    async def request(self, mid: int, data: bytes = b"", *, tries: int = 2) -> XbusMessage | None:
        """Send a request until its reply or an error arrives; return None if nothing arrives."""
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
        """Send GoToConfig until it is acknowledged; from then on all bytes are emitted.

        Parameters
        ----------
        tries : int
            Largest number of requests.
        wait_s : float
            Interval between requests on a silent line, s.
        late_s : float
            Tolerated delay of an acknowledgement, s. If positive, a device that sends data has
            one pending request at a time, at intervals of `OUTSTANDING_S`.
        late_if_silent : bool
            Whether `late_s` also applies to a silent line.

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
                # The device has just started and waits for this answer.
                await self.send(XbusMessageId.WAKE_UP_ACK)
                await self.send(XbusMessageId.GOTO_CONFIG)
                reply = await self.receive({XbusMessageId.GOTO_CONFIG_ACK}, wait_s)
            if reply is not None:
                took = loop.time() - began
                # replies to the pending requests may still arrive, in order
                if took > wait_s and late_s:
                    self.reply_s = min((sent + 1) * took, _MOST_REPLY_S)
                return True

    async def receive(self, mids: Collection[int], wait_s: float) -> XbusMessage | None:
        """Return the first message with one of `mids`, or None after `wait_s` seconds."""
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
    """Whether address, identifier and content identify an Xbus message, besides its checksum."""
    if message.bid not in {MASTER, _OTHER_ADDRESS} or message.mid not in _KNOWN:
        return False
    return message.mid != XbusMessageId.MT_DATA2 or bool(mtdata2.split(message.data))
