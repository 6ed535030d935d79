"""Sync inputs of a virtual Xbus device, which convert edges to trigger indications."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, Trigger
from jointfit_protocols.xbus.sync_lines import IN1, IN2, SyncFunction

if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_ENTRIES = 10
"""Maximum number of settings that the device can store."""
_ITEMS = {IN1: Item.TRIGGER_IN1, IN2: Item.TRIGGER_IN2}
_MOST_PENDING = 16
"""Maximum number of edges per line that wait for a message. Older edges are dropped."""


class SyncInputs:
    """Settings of the sync inputs, and edges that are not yet reported.

    Parameters
    ----------
    entries
        Synchronisation settings that are initially in flash.
    """

    def __init__(self, entries: Iterable[setup.SyncSetting] = ()) -> None:
        self.entries = tuple(entries)
        """Active synchronisation settings."""
        self.reset()

    def store(self, data: bytes) -> bool:
        """Replace the settings by those in `data`; return False if `data` is invalid."""
        entries = setup.decode_sync(data)
        if entries is None or len(entries) > MOST_ENTRIES:
            return False
        self.entries = tuple(entry for entry in entries if entry.polarity)
        self.reset()
        return True

    def reset(self) -> None:
        """Restart the counts of edges, and drop pending edges."""
        self._edges: dict[int, int] = {}
        self._reported: dict[int, int] = {}
        self._pending: dict[Item, deque[Trigger]] = {
            item: deque(maxlen=_MOST_PENDING) for item in _ITEMS.values()
        }

    def edge(self, line: int, ticks: int) -> None:
        """Add a rising edge on an input, at a time of the device clock."""
        for entry in self.entries:
            if (entry.function, entry.line) == (SyncFunction.TRIGGER_INDICATION, line):
                edges = self._edges[line] = self._edges.get(line, -1) + 1
                since_first = edges - entry.skip_first
                if since_first < 0 or since_first % (entry.skip_factor + 1):
                    continue
                number = self._reported[line] = self._reported.get(line, -1) + 1
                edge = Trigger(line, entry.polarity, ticks, number & 0xFFFF)
                self._pending[_ITEMS[line]].append(edge)

    def next_triggers(self, items: Iterable[int]) -> dict[int, Trigger]:
        """Remove and return the edges for the next message, at most one edge per item."""
        return {
            int(item): pending.popleft()
            for item, pending in self._pending.items()
            if item in items and pending
        }
