"""One source inside the core: its decoder, its clock and its counters.

Law: knows nothing of frames, calibration or other sources. Turns chunks into stamped samples and
counts what a wire did to them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_daemon.model import (
    ClockEcho,
    Corrupt,
    DeviceEvent,
    ImuSample,
    MocapFrame,
    SyncPulse,
)
from jointfit_daemon.timing.clock import DeviceClock

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import Source
    from jointfit_daemon.driver import Decoder
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_daemon.timing.clock import Stamp

_NS = 1_000_000_000
WITHHELD = ("unpublished", "duplicates", "late")
"""Counters a decoder may have of what it decoded and did not hand on."""


@dataclass(frozen=True, slots=True)
class Stamped:
    """A measurement with the host instant it is true for."""

    measurement: ImuSample | MocapFrame
    stamp: Stamp


@dataclass(slots=True)
class WireCounts:
    """What happened on the wire since the daemon started; decoders come and go with reconnects."""

    received: int = 0
    """Samples decoded."""
    corrupt: int = 0
    """Runs of bytes that made no message."""
    discarded_bytes: int = 0
    lost: int = 0
    """Samples the device's counter says were sent and never came."""
    restarts: int = 0
    """Times the device's clock began anew."""
    opened: int = 0
    """Times the source was opened; all but the first are reconnects."""


@dataclass(slots=True)
class SourceState:
    """The live half of one configured source."""

    source: Source
    clock: DeviceClock
    online: bool = False
    open: bool = False
    last_arrival_ns: int | None = None
    counts: WireCounts = field(default_factory=WireCounts)
    info: Mapping[str, object] = field(default_factory=dict)
    _withheld: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WITHHELD, 0))
    _decoder: Decoder | None = None

    @classmethod
    def of(cls, source: Source, before: SourceState | None = None) -> SourceState:
        """Return the state of a source not opened yet; `before` had its name and gives its counts.

        Verdicts on its samples go on, too: a count that began anew would contradict them.
        """
        state = cls(source=source, clock=DeviceClock(round(_NS / source.rate_hz)))
        if before is not None:
            state.counts, state._withheld = before.counts, before.withheld()
        return state

    def opened(self) -> None:
        """Begin anew with a fresh decoder: what was half received will never be completed."""
        driver = self.source.driver_class(self.source.settings)
        self._decoder = driver.decoder()
        self.open = True
        self.counts.opened += 1

    def closed(self) -> list[Stamped | Corrupt | DeviceEvent]:
        """Return what the decoder still gives up, and forget it."""
        decoder, self._decoder = self._decoder, None
        self.open = self.online = False
        if decoder is None:
            return []
        taken = self._take(decoder.flush(), decoder)
        for name in WITHHELD:
            self._withheld[name] += getattr(decoder, name, 0)
        return taken

    def withheld(self) -> dict[str, int]:
        """Return how many decoded frames never left the decoders, by why (see ``Decoder``)."""
        return {
            name: count + getattr(self._decoder, name, 0) for name, count in self._withheld.items()
        }

    def feed(self, chunk: Chunk) -> list[Stamped | Corrupt | DeviceEvent]:
        """Return what `chunk` completed, stamped; nothing while the source is not open."""
        decoder = self._decoder
        if decoder is None:
            return []
        self.last_arrival_ns = chunk.t_ns
        return self._take(decoder.feed(chunk), decoder)

    def _take(
        self,
        decoded: list[Decoded],
        decoder: Decoder,
    ) -> list[Stamped | Corrupt | DeviceEvent]:
        taken: list[Stamped | Corrupt | DeviceEvent] = []
        counts, clock, now_ns = self.counts, self.clock, self.last_arrival_ns or 0
        for item in decoded:
            if isinstance(item, ImuSample):
                if item.arrival_ns > now_ns:  # a stamp of kernel or adapter that is simply wrong
                    item = item._replace(arrival_ns=now_ns)  # noqa: PLW2901 - the sample, mended
                counts.received += 1
                stamp = clock.feed_sample(
                    item.ticks, item.counter, item.arrival_ns, decoder.tick_clock
                )
                taken.append(Stamped(item, stamp))
            elif isinstance(item, MocapFrame):
                counts.received += 1
                stamp = clock.feed_sample(
                    item.ticks, item.number, item.arrival_ns, decoder.tick_clock
                )
                taken.append(Stamped(item, stamp))
            elif isinstance(item, ClockEcho):
                clock.feed_echo(item, decoder.tick_clock)
            elif not isinstance(item, SyncPulse):
                self._count(item)
                taken.append(item)
        return taken

    def _count(self, item: Corrupt | DeviceEvent) -> None:
        if isinstance(item, Corrupt):
            self.counts.corrupt += 1
            self.counts.discarded_bytes += item.discarded
        elif item.kind == "restart":
            self.counts.restarts += 1
            self.clock.feed_restart()
        elif item.kind == "gap":
            lost = item.data.get("lost", 0)
            self.counts.lost += lost if isinstance(lost, int) else 0
        elif item.kind == "info":
            self.info = {**self.info, **item.data}
