"""Parts that decoders of IMUs on a CAN bus share: records to frames, and errors of the bus.

A chunk of a CAN bus contains records of 24 bytes: frames of the device, error frames of the
controller, and notes of this host about frames and bytes that it lost.

Invariant: the output depends only on the chunks fed; no clock and no bus is read.
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
    """Decoder of one device; a subclass converts its frames.

    Parameters
    ----------
    ids : collection of CanKey
        Number of each of its identifiers, and whether it has 29 bits. Other frames are ignored.
    samples : CheckedSamples
        New checks; `convert` adds its samples to them.
    """

    def __init__(self, ids: Collection[CanKey], samples: CheckedSamples) -> None:
        self._ids = frozenset(ids)
        self._bus = BusEvents()
        self._frames = 0
        self.samples = samples

    @abstractmethod
    def convert(self, frame: can.CanFrame) -> Iterable[Decoded]:
        """Return the samples and events that a frame of the device completes.

        `frame.t_ns` is its arrival. A frame that cannot be used is counted by
        ``self.samples.refuse(RECORD_BYTES, reason)``.
        """

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None without one."""
        return self.samples.tick_clock

    @property
    def messages(self) -> int:
        """Number of well-formed frames of this device so far."""
        return self._frames - self.samples.refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes in rejected records and in lost lines of an adapter."""
        return self._bus.discarded_bytes + self.samples.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content that `chunk` completed, in wire order; never raises."""
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
        """Refuse a sample that waits for confirmation."""
        return self.samples.flush()
