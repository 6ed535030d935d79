"""Base class of decoders for IMUs on a CAN bus: conversion of records to frames, and bus errors.

A chunk of a CAN bus contains records of 24 bytes. A record contains a CAN frame, an error frame of
the controller, or the number of frames or bytes that this host lost.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no bus.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from jointfit_drivers.bus_events import BusEvents
from jointfit_protocols import can

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from jointfit_daemon.model import Chunk, Decoded, TickClock
    from jointfit_drivers.checked_samples import CheckedSamples
    from jointfit_drivers.ports.can_bus import CanKey


class CanDecoder(ABC):
    """Decoder of one device. A subclass converts the device's frames.

    Parameters
    ----------
    ids : collection of CanKey
        Identifiers of the device's frames, each with a flag that is true if the identifier has 29
        bits. Other frames are ignored.
    samples : CheckedSamples
        Object that checks each sample. `convert` passes its samples to this object.
    """

    def __init__(self, ids: Collection[CanKey], samples: CheckedSamples) -> None:
        self._ids = frozenset(ids)
        self._bus = BusEvents()
        self._frames = 0
        self.samples = samples

    @abstractmethod
    def convert(self, frame: can.CanFrame) -> Iterable[Decoded]:
        """Return the samples and events that a frame of the device completes.

        `frame.t_ns` is the arrival of the frame. For a frame that cannot be used, a subclass calls
        ``self.samples.refuse(RECORD_BYTES, reason)``, which counts the frame.
        """

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None if the device sends no time."""
        return self.samples.tick_clock

    @property
    def messages(self) -> int:
        """Number of well-formed frames received from this device."""
        return self._frames - self.samples.refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes in rejected records, plus adapter bytes that formed no frame."""
        return self._bus.discarded_bytes + self.samples.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        for item in can.unpack_frames(chunk.data):
            if not isinstance(item, can.CanFrame):
                out.append(self._bus.discard(item.discarded, item.reason))
            elif item.error:
                out += self._bus.add_error_frame(item)
            elif (item.can_id, item.extended) in self._ids and not item.remote:
                self._frames += 1
                out += self.convert(item)
        return out

    def flush(self) -> list[Decoded]:
        """Reject the sample that waits for confirmation, if there is one, and return the events.

        A sample waits if its time or counter contradicts the samples before it.
        """
        return self.samples.flush()
