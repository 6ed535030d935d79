"""Sync inputs of a virtual Xbus device: conversion of edges to trigger indications."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, Trigger
from jointfit_protocols.xbus.sync_lines import IN1, IN2, SyncFunction

if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_ENTRIES = 10
_ITEMS = {IN1: Item.TRIGGER_IN1, IN2: Item.TRIGGER_IN2}
_WAITING = 16


class SyncInputs:
    """What is stored for the lines, and the edges that are still to be told.

    Parameters
    ----------
    entries
        Synchronisation settings in flash at the start.
    """

    def __init__(self, entries: Iterable[setup.SyncSetting] = ()) -> None:
        self.entries = tuple(entries)
        """Synchronisation settings in force."""
        self._seen: dict[int, int] = {}
        self._told: dict[int, int] = {}
        self._waiting: dict[Item, deque[Trigger]] = {
            item: deque(maxlen=_WAITING) for item in _ITEMS.values()
        }

    def store(self, data: bytes) -> bool:
        """Replace the entries by those of a request; False if it makes no sense."""
        entries = setup.decode_sync(data)
        if entries is None or len(entries) > MOST_ENTRIES:
            return False
        self.entries = tuple(entry for entry in entries if entry.polarity)
        self.forget()
        return True

    def forget(self) -> None:
        """Begin to count anew."""
        self._seen.clear()
        self._told.clear()
        for waiting in self._waiting.values():
            waiting.clear()

    def edge(self, line: int, ticks: int) -> None:
        """Take a rising edge on an input at a time of the device's clock."""
        for entry in self.entries:
            if (entry.function, entry.line) == (SyncFunction.TRIGGER_INDICATION, line):
                seen = self._seen[line] = self._seen.get(line, -1) + 1
                counts = seen - entry.skip_first
                if counts < 0 or counts % (entry.skip_factor + 1):
                    continue
                number = self._told[line] = self._told.get(line, -1) + 1
                edge = Trigger(line, entry.polarity, ticks, number & 0xFFFF)
                self._waiting[_ITEMS[line]].append(edge)

    def next_triggers(self, items: Iterable[int]) -> dict[int, Trigger]:
        """Return what the next message tells of, an edge an item at most; it is told then."""
        found = {}
        for item, waiting in self._waiting.items():
            if item in items and waiting:
                found[int(item)] = waiting.popleft()
        return found
