"""Asking an Xbus device and hearing its answer, while all it says goes on to the daemon.

Law: bytes before the first acknowledgement are old or foreign and go nowhere; from it on every
byte read is emitted, once, so that the decoder sees what the device says of itself. Source: MT0101P
rev. 2020.A, state diagram; the 500 ms are its time-outs.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.model import Chunk
from jointfit_protocols.xbus import MASTER, MessageId, XbusCodec, XbusMessage, encode, mtdata2

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort

REPLY_S = 0.5
OUTSTANDING_S = 2.0
"""A device that sends anything at all has so long to answer one GoToConfig. Some take 1.5 s, and
further requests would queue behind the first."""
_MOST_REPLY_S = 8.0
_QUIET_S = 0.1
"""A pause this long ends what a broken length made the decoder wait for."""
_KNOWN = frozenset(map(int, MessageId))
_OTHER_ADDRESS = 0x01  # a stand-alone device mirrors it, too
_KEPT = 8192  # bytes: more than a message that hides an acknowledgement can hold


class Conversation:
    """One host, one device, one port.

    Parameters
    ----------
    port
        Open port.
    emit
        Where bytes go from the first acknowledgement of configuration mode on.
    """

    def __init__(self, port: SerialPort, emit: Emit) -> None:
        self._port = port
        self._emit = emit
        self._decoder = XbusCodec()
        self._emitting = False
        self._recent = b""
        self._t_ns = 0
        self.heard = 0
        """Bytes heard so far."""
        self.reply_s = REPLY_S
        """How long to wait for a reply; longer for a device that acknowledged late."""
        self.understood = 0
        """Messages so far that only an Xbus device sends: noise passes a checksum now and then."""

    def begin_anew(self) -> None:
        """Forget what was heard, here and in the port: another speed, or a fresh start."""
        self._port.flush_input()
        self._decoder, self._recent = XbusCodec(), b""
        self.heard = self.understood = 0

    async def send(self, mid: int, data: bytes = b"") -> None:
        """Send one message."""
        await self._port.write(encode(mid, data))

    async def ask(self, mid: int, data: bytes = b"", *, tries: int = 2) -> XbusMessage | None:
        """Send a request until its reply, or an error, comes; None if neither does."""
        for _ in range(tries):
            await self.send(mid, data)
            reply = await self.hear({mid + 1, MessageId.ERROR}, self.reply_s)
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
        """Send GoToConfig until it is acknowledged; from then on everything is emitted.

        Parameters
        ----------
        tries
            Requests at most.
        wait_s
            From one request to the next on a silent line, s.
        late_s
            How long an acknowledgement may be late, s. Then a device that sends anything has one
            request at a time, ``OUTSTANDING_S`` apart.
        late_if_silent
            Whether to wait `late_s` also where nothing at all comes.
        """
        loop = asyncio.get_running_loop()
        began = asked = loop.time()
        sent = before = 0
        wanted = {MessageId.GOTO_CONFIG_ACK, MessageId.WAKE_UP}
        start = self.heard
        while True:
            now = loop.time()
            late = late_s if late_if_silent or self.heard > start else 0.0
            if now >= began + tries * wait_s + late:
                return False
            waits = late_s > 0 and self.heard > before and now < asked + OUTSTANDING_S
            if sent == 0 or (sent < tries and not waits):
                asked, before, sent = now, self.heard, sent + 1
                await self.send(MessageId.GOTO_CONFIG)
            reply = await self.hear(wanted, wait_s)
            if reply is not None and reply.mid == MessageId.WAKE_UP:
                await self.send(MessageId.WAKE_UP_ACK)  # just powered up: it asks what to do
                await self.send(MessageId.GOTO_CONFIG)
                reply = await self.hear({MessageId.GOTO_CONFIG_ACK}, wait_s)
            if reply is not None:
                took = loop.time() - began
                if took > wait_s and late_s:  # what was asked in vain may yet be answered, in turn
                    self.reply_s = min((sent + 1) * took, _MOST_REPLY_S)
                return True

    async def hear(self, mids: Collection[int], wait_s: float) -> XbusMessage | None:
        """Return the first message of `mids`; None if none comes in `wait_s` seconds."""
        loop = asyncio.get_running_loop()
        until = loop.time() + wait_s
        while (left := until - loop.time()) > 0:
            chunk = await self._port.receive(min(left, _QUIET_S))
            if chunk is not None:
                self._take(chunk)
                found = self._decoder.feed(chunk.data)
            else:
                found = self._decoder.flush() if self._decoder.pending else []
            messages = [event for event in found if isinstance(event, XbusMessage)]
            self.understood += sum(map(_only_xbus_says, messages))
            for message in messages:
                if message.mid in mids and _only_xbus_says(message):
                    self._heard_out(message)
                    return message
        return None

    def _take(self, chunk: Chunk) -> None:
        self.heard += len(chunk.data)
        if self._emitting:
            self._emit(chunk)
        else:
            self._t_ns = chunk.t_ns
            self._recent = (self._recent + chunk.data)[-_KEPT:]

    def _heard_out(self, message: XbusMessage) -> None:
        """Begin to emit with the acknowledgement of configuration mode."""
        if self._emitting or message.mid != MessageId.GOTO_CONFIG_ACK:
            return
        after = self._decoder.fed - message.end
        rest = self._recent[len(self._recent) - after :]
        self._emitting, self._recent = True, b""
        self._emit(Chunk(self._t_ns, encode(message.mid, message.data, message.bid) + rest))


def _only_xbus_says(message: XbusMessage) -> bool:
    """Whether more than the checksum speaks for `message`."""
    if message.bid not in {MASTER, _OTHER_ADDRESS} or message.mid not in _KNOWN:
        return False
    return message.mid != MessageId.MT_DATA2 or bool(mtdata2.split(message.data))
