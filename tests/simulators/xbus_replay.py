"""Xbus device that replays a capture. Invariant: it sends the recorded bytes.

The handshake is simulated. In measurement mode the recorded messages are sent at the intervals of
their SampleTimeFine. Messages with the time of another clock, such as the clock of a GNSS
receiver, are sent together with the previous message.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_protocols.xbus import XbusCodec, XbusMessage, encode
from jointfit_protocols.xbus.configuration import TICK_NS
from jointfit_protocols.xbus.mtdata2 import Item, decode_item, split
from jointfit_simulators.devices import XbusDevice

if TYPE_CHECKING:
    from pathlib import Path

_NS = 10**9
_POLL_S = 0.005


class XbusReplay(XbusDevice):
    """Device that sends a capture of whole MTData2 messages once.

    Parameters
    ----------
    link : Path
        Symbolic link to the host's port.
    capture : bytes
        Recorded bytes.
    """

    def __init__(self, link: Path, capture: bytes) -> None:
        super().__init__(link)
        self._recorded = _timed(capture)

    @property
    def messages(self) -> int:
        """Number of messages in the capture."""
        return len(self._recorded)

    async def play(self) -> None:
        """Wait for measurement mode, then send all messages."""
        while not self.streaming:
            await asyncio.sleep(_POLL_S)
        loop = asyncio.get_running_loop()
        began = loop.time()
        for due_ns, wire in self._recorded:
            await asyncio.sleep(began + due_ns / _NS - loop.time())
            self.sent += self._line.write(wire)


def _timed(capture: bytes) -> list[tuple[int, bytes]]:
    """Return the messages of a capture, each with its time since the first one, ns."""
    found: list[tuple[int, bytes]] = []
    first = newest = None
    for message in XbusCodec().feed(capture):
        if not isinstance(message, XbusMessage):
            continue
        items = dict(split(message.data) or [])
        stamp = items.get(Item.SAMPLE_TIME_FINE)
        ticks = None if stamp is None else decode_item(Item.SAMPLE_TIME_FINE, stamp)
        if isinstance(ticks, int):
            first = ticks if first is None else first
            newest = ticks if newest is None else max(newest, ticks)
        due = 0 if first is None or newest is None else (newest - first) * TICK_NS
        found.append((due, encode(message.mid, message.data, message.bid)))
    assert first is not None, "no message with SampleTimeFine"
    return found
