"""Xbus device that replays a capture. Invariant: it sends the recorded bytes after the handshake.

The handshake is simulated. In measurement mode the recorded messages are sent at the intervals of
their SampleTimeFine. Messages with the time of another clock (such as a GNSS receiver) are sent
together with the previous message.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.xbus import XbusCodec, XbusMessage, encode
from jointfit_protocols.xbus.configuration import TICK_NS
from jointfit_protocols.xbus.mtdata2 import Item, decode_item, split
from jointfit_simulators.devices._xbus_device import XbusDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.devices._xbus_device import XbusDeviceOptions

_NS = 10**9
_POLL_S = 0.005


class _Recorded(NamedTuple):
    due_ns: int
    """After the first one."""
    wire: bytes


class XbusReplay(XbusDevice):
    """Plays a capture into a pty, once.

    Parameters
    ----------
    link : Path
        Where the host finds the port.
    capture : bytes
        What was recorded: whole MTData2 messages.
    options : XbusDeviceOptions, optional
        What it says of itself.

    Raises
    ------
    ValueError
        The capture holds no message with SampleTimeFine.
    """

    def __init__(
        self, link: Path, capture: bytes, *, options: XbusDeviceOptions | None = None
    ) -> None:
        super().__init__(link, options=options)
        self._recorded = _timed(capture)

    @property
    def messages(self) -> int:
        """Messages in the capture."""
        return len(self._recorded)

    async def play(self) -> None:
        """Wait until the host wants data, then send all of it; return when it is sent."""
        while not self.streaming:  # noqa: ASYNC110 - a device has a state, not an event
            await asyncio.sleep(_POLL_S)
        loop = asyncio.get_running_loop()
        began = loop.time()
        for due_ns, wire in self._recorded:
            await asyncio.sleep(began + due_ns / _NS - loop.time())
            self.sent += self._line.write(wire)


def _timed(capture: bytes) -> list[_Recorded]:
    found: list[_Recorded] = []
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
        found.append(_Recorded(due, encode(message.mid, message.data, message.bid)))
    if first is None:
        raise ValueError("a capture of MTData2 messages with SampleTimeFine is needed")
    return found
