"""One source inside the core: its decoder, its clock and its counters.

Law: knows nothing of frames, calibration or other sources. Turns chunks into stamped samples and
counts what a wire did to them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.model import (
    ClockEcho,
    Corrupt,
    DeviceEvent,
    ImuSample,
    MocapFrame,
    SyncPulse,
)
from jointfit_daemon.pipeline.sources._latency_prior import latency_prior
from jointfit_daemon.pipeline.sources._sync_lines import SyncLines
from jointfit_daemon.timing.clock import DeviceClock, Edge

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import Source
    from jointfit_daemon.driver import Decoder
    from jointfit_daemon.model import Chunk, Decoded, TickClock
    from jointfit_daemon.timing.clock import Stamp

_NS = 1_000_000_000
_MEASUREMENTS = (ImuSample, MocapFrame)
WITHHELD = ("unpublished", "duplicates", "late")
"""Counters a decoder may have of what it decoded and did not hand on."""


class Stamped(NamedTuple):
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
    """Times the device restarted: it reported so, its clock showed it, or it was away and nothing
    shows that it ran on."""
    opened: int = 0
    """Times the source was opened; all but the first are reconnects."""


@dataclass(slots=True)
class SourceState:
    """The live half of one configured source."""

    source: Source
    clock: DeviceClock
    lines: SyncLines = field(default_factory=SyncLines)
    """Where edges of sync lines meet: one for the whole rig."""
    online: bool = False
    open: bool = False
    last_arrival_ns: int | None = None
    counts: WireCounts = field(default_factory=WireCounts)
    info: Mapping[str, object] = field(default_factory=dict)
    closed_text: str = ""
    """Why it was closed last."""
    _withheld: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WITHHELD, 0))
    _decoder: Decoder | None = None

    @classmethod
    def of(
        cls,
        source: Source,
        before: SourceState | None = None,
        lines: SyncLines | None = None,
    ) -> SourceState:
        """Return the state of a source not opened yet; `before` had its name and gives its counts.

        Verdicts on its samples go on, too: a count that began anew would contradict them.
        """
        mean_ns, sd_ns = latency_prior(source)
        period_ns = round(_NS / source.rate_hz)
        clock = DeviceClock(period_ns, latency_ns=mean_ns, latency_sd_ns=sd_ns)
        state = cls(source=source, clock=clock)
        if lines is not None:
            state.lines = lines
        if before is not None:
            state.counts, state._withheld = before.counts, before.withheld()
        return state

    def opened(self) -> None:
        """Begin anew with a fresh decoder: what was half received will never be completed.

        What a sensor did while it was away is shown by its next sample. A camera server's clock
        settles within a second, so nothing old is trusted.
        """
        if self.counts.opened and self.source.kind == "mocap":
            self.clock.feed_restart()
        elif self.counts.opened and self.counts.received:
            self.clock.feed_reopened()
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
        self, decoded: list[Decoded], decoder: Decoder
    ) -> list[Stamped | Corrupt | DeviceEvent]:
        taken: list[Stamped | Corrupt | DeviceEvent] = []
        clock, tick_clock = self.clock, decoder.tick_clock
        for item in decoded:
            if isinstance(item, _MEASUREMENTS):
                stamped = self._stamped(item, tick_clock)
                if clock.news:  # found by this sample, and so to be known before it
                    taken += self._told()
                taken.append(stamped)
                continue
            if isinstance(item, ClockEcho):
                clock.feed_echo(item, tick_clock)
            elif isinstance(item, SyncPulse):
                self._edge(item, tick_clock)
            else:
                self._count(item)
                taken.append(item)
            if clock.news:
                taken += self._told()
        return taken

    def _stamped(self, item: ImuSample | MocapFrame, tick_clock: TickClock | None) -> Stamped:
        self.counts.received += 1
        clock = self.clock
        if isinstance(item, ImuSample):
            now_ns, arrival_ns = self.last_arrival_ns or 0, item.arrival_ns
            if arrival_ns > now_ns:  # a stamp of kernel or adapter that is simply wrong
                item, arrival_ns = item._replace(arrival_ns=now_ns), now_ns
            return Stamped(
                item, clock.feed_sample(item.ticks, item.counter, arrival_ns, tick_clock)
            )
        stamp = clock.feed_sample(item.ticks, item.number, item.arrival_ns, tick_clock)
        number = getattr(self.source.settings, "sync_line", None)
        if number is not None and stamp.synced and item.live and clock.last_u is not None:
            edge = Edge(clock.host_ns(clock.last_u), clock.last_u)
            self.lines.exposures(number, self.source.id, clock, edge)
        return Stamped(item, stamp)

    def _edge(self, pulse: SyncPulse, tick_clock: TickClock | None) -> None:
        clock = self.clock
        own_ns = clock.edge_ns(pulse.ticks, tick_clock)
        if own_ns is not None and clock.settled:
            edge = Edge(clock.host_ns(own_ns), own_ns)
            self.lines.edge(pulse.line, self.source.id, clock, edge)

    def _told(self) -> list[DeviceEvent]:
        """Return what the clock has to tell; it goes before the sample it was found by."""
        told = [DeviceEvent(news.kind, news.text, dict(news.data)) for news in self.clock.news]
        self.clock.news.clear()
        self.counts.restarts += sum(event.kind == "restart" for event in told)
        return told

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
