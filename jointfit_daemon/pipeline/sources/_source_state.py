"""State of one source in the core: decoder, clock and counters.

The state converts chunks to samples with timestamps, and counts losses and errors. It does not
depend on frames or the calibration. It depends on other sources only through sync lines, which are
wires with pulses that several devices timestamp.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.config import Source  # noqa: TC001 - mypyc evaluates the types of fields
from jointfit_daemon.model import ClockEcho, Corrupt, DeviceEvent, ImuSample, MocapFrame, SyncPulse
from jointfit_daemon.pipeline.health import ClockHealth, DeviceHealth, WireCounts
from jointfit_daemon.pipeline.sources._latency_prior import latency_prior
from jointfit_daemon.pipeline.sources._sync_lines import SyncLines
from jointfit_daemon.sensor_calibration import exchanged_sensor
from jointfit_daemon.timing.clock import DeviceClock, Edge
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from jointfit_daemon.driver import Decoder
    from jointfit_daemon.fusion import SensorMonitor
    from jointfit_daemon.model import Chunk, Decoded, TickClock
    from jointfit_daemon.timing.clock import Stamp

_MEASUREMENTS = (ImuSample, MocapFrame)
WITHHELD = ("unpublished", "duplicates", "late")
"""Counters that a decoder may have for frames that it decoded but did not return."""


MOST_OPENING_BYTES = 65536
"""Largest total size of the stored chunks that arrived before the first measurement, bytes."""
KEPT_SAMPLES = 1000
"""Number of samples and events after a reopening for which the time base of the previous decoder
may be used."""


class StampedMeasurement(NamedTuple):
    """A measurement, and its instant on the host clock."""

    measurement: ImuSample | MocapFrame
    stamp: Stamp


@dataclass(slots=True)
class SourceState:
    """The state of one configured source."""

    source: Source
    clock: DeviceClock
    lines: SyncLines = field(default_factory=SyncLines)
    """Sync lines of the rig, which all of its sources share."""
    online: bool = False
    open: bool = False
    last_arrival_ns: int | None = None
    counts: WireCounts = field(default_factory=WireCounts)
    info: Mapping[str, object] = field(default_factory=dict)
    closed_text: str = ""
    """Reason why the source was closed the last time."""
    _withheld: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WITHHELD, 0))
    _decoder: Decoder | None = None
    _tick_clock: TickClock | None = None
    """Time base of the previous decoder, used until the current decoder has determined a time base,
    for at most `KEPT_SAMPLES` samples. A restart also ends its use, because the device may have
    been exchanged."""
    _opening: list[bytes] = field(default_factory=list)
    """Chunks that arrived after the opening and before the first measurement."""
    _opening_bytes: int = 0
    _kept: int = 0
    """Number of further samples for which `_tick_clock` may be used."""

    @classmethod
    def create(
        cls,
        source: Source,
        before: SourceState | None = None,
        lines: SyncLines | None = None,
    ) -> SourceState:
        """Return the state of a source that is not open yet.

        If `before` is the state of the same id before a reload, its counts are continued. The frame
        grid also continues its counts of the samples, and the two counts must agree.
        """
        mean_ns, sd_ns = latency_prior(source)
        period_ns = round(NS_PER_S / source.rate_hz)
        clock = DeviceClock(period_ns, latency_ns=mean_ns, latency_sd_ns=sd_ns)

        state = cls(source=source, clock=clock)
        if lines is not None:
            state.lines = lines
        if before is not None:
            state.counts, state._withheld = before.counts, before.withheld_counts()
        return state

    def start(self) -> None:
        """Start with a new decoder after the source was opened.

        The next sample of an IMU shows whether the IMU's clock restarted in the meantime. The clock
        fit of a mocap server converges within a second, so the old fit is discarded.
        """
        if self.counts.opened and self.source.kind == "mocap":
            self.clock.feed_restart()
        elif self.counts.opened and self.counts.received:
            self.clock.feed_reopened()

        driver = self.source.driver_class(self.source.settings)
        self._decoder = driver.decoder()
        self._opening, self._opening_bytes = [], 0
        self.open = True
        self.counts.opened += 1

    def stop(self) -> list[StampedMeasurement | Corrupt | DeviceEvent]:
        """Return the remaining output of the decoder, and remove the decoder."""
        decoder, self._decoder = self._decoder, None
        self.open = self.online = False
        if decoder is None:
            return []
        items = self._process(decoder.flush(), decoder)
        self._tick_clock = decoder.tick_clock or self._tick_clock
        self._kept = KEPT_SAMPLES
        for name in WITHHELD:
            self._withheld[name] += getattr(decoder, name, 0)
        return items

    def withheld_counts(self) -> dict[str, int]:
        """Return the number of decoded frames that were not returned, by reason."""
        return {
            name: count + getattr(self._decoder, name, 0) for name, count in self._withheld.items()
        }

    def health(
        self, now_ns: int, samples: Mapping[str, int], sensors: SensorMonitor
    ) -> DeviceHealth:
        """Return the health of the device.

        `samples` are the counts of the frame grid or mocap router.
        """
        sensor = None
        if self.source.kind == "imu":
            sensor = sensors.state(self.source.id)
        else:
            # Add the number of frames that the decoder withheld.
            withheld = self.withheld_counts()
            samples = {
                **samples,
                "received": self.counts.received + sum(withheld.values()),
                "decimated": 0,
                "late": withheld["late"],
                "duplicate": withheld["duplicates"],
                "dropped": withheld["unpublished"],
                "pending": 0,
            }

        clock, last_ns = self.clock, self.last_arrival_ns
        return DeviceHealth(
            self.online,
            replace(self.counts),
            None if last_ns is None else now_ns - last_ns,
            samples,
            ClockHealth(
                clock.state,
                clock.epoch,
                clock.offset_ns,
                clock.skew_ppm,
                clock.sigma_ns,
                clock.bound_ns,
                clock.latency_ns,
                clock.latency_sd_ns,
                clock.jitter_ns,
                clock.minute.delays,
                clock.minute.rate_hz,
            ),
            self.info.get("orientation_filter"),
            sensor,
        )

    def feed(self, chunk: Chunk) -> list[StampedMeasurement | Corrupt | DeviceEvent]:
        """Return the stamped samples and events that `chunk` completes; empty while closed."""
        decoder = self._decoder
        if decoder is None:
            return []
        self.last_arrival_ns = chunk.t_ns
        if self.online:
            return self._process(decoder.feed(chunk), decoder)

        received = self.counts.received
        items = self._process(decoder.feed(chunk), decoder)
        self._opening_bytes += len(chunk.data)
        if self.counts.received == received and self._opening_bytes <= MOST_OPENING_BYTES:
            self._opening.append(chunk.data)
        return items

    def description(self) -> tuple[bytes, ...]:
        """Return the chunks that a new decoder needs before all others; empty while closed.

        See `jointfit_daemon.driver.Decoder`.
        """
        if self._decoder is None:
            return ()
        described: tuple[bytes, ...] | None = getattr(self._decoder, "description", None)
        return tuple(self._opening) if described is None else described

    def _process(
        self, decoded: list[Decoded], decoder: Decoder
    ) -> list[StampedMeasurement | Corrupt | DeviceEvent]:
        items: list[StampedMeasurement | Corrupt | DeviceEvent] = []
        # A new decoder may need seconds to determine the unit of device time. If samples were
        # stamped by their counter in this time, the later change of clock would look like a
        # restart.
        clock, tick_clock = self.clock, decoder.tick_clock
        if tick_clock is None and self._kept > 0:
            tick_clock = self._tick_clock
            self._kept -= len(decoded)
        for item in decoded:
            if isinstance(item, _MEASUREMENTS):
                stamped = self._stamp(item, tick_clock)
                if clock.news:  # events that a sample reveals precede this sample
                    items += self._clock_events()
                items.append(stamped)
                continue

            if isinstance(item, ClockEcho):
                clock.feed_echo(item, tick_clock)
            elif isinstance(item, SyncPulse):
                own_ns = clock.edge_ns(item.ticks, tick_clock)
                if own_ns is not None and clock.settled:
                    edge = Edge(clock.host_ns(own_ns), own_ns)
                    self.lines.add_edge(item.line, self.source.id, clock, edge)
            else:
                self._count(item)
                items.append(item)
                items += self._identity_events(item)
            if clock.news:
                items += self._clock_events()
        return items

    def _stamp(
        self, item: ImuSample | MocapFrame, tick_clock: TickClock | None
    ) -> StampedMeasurement:
        self.counts.received += 1
        clock = self.clock
        if isinstance(item, ImuSample):
            now_ns, arrival_ns = self.last_arrival_ns or 0, item.arrival_ns
            if arrival_ns > now_ns:  # a kernel or adapter stamp in the future is wrong
                item, arrival_ns = item._replace(arrival_ns=now_ns), now_ns
            return StampedMeasurement(
                item, clock.feed_sample(item.ticks, item.counter, arrival_ns, tick_clock)
            )

        counter = item.number if item.counted else None
        stamp = clock.feed_sample(item.ticks, counter, item.arrival_ns, tick_clock)
        number = getattr(self.source.settings, "sync_line", None)
        if number is not None and stamp.synced and item.live and clock.last_u is not None:
            edge = Edge(clock.host_ns(clock.last_u), clock.last_u)
            self.lines.add_exposure(number, self.source.id, clock, edge)
        return StampedMeasurement(item, stamp)

    def _clock_events(self) -> list[DeviceEvent]:
        """Return the events of the clock, and count its restarts."""
        events = [DeviceEvent(news.kind, news.text, dict(news.data)) for news in self.clock.news]
        self.clock.news.clear()
        restarts = sum(event.kind == "restart" for event in events)
        self.counts.restarts += restarts
        if restarts:
            self._kept = 0
        return events

    def _identity_events(self, item: Corrupt | DeviceEvent) -> list[DeviceEvent]:
        """Return a warning if the serial number is not that of the calibrated sensor."""
        if not isinstance(item, DeviceEvent) or item.kind != "info" or "serial" not in item.data:
            return []
        text = exchanged_sensor(self.source.settings, item.data["serial"])
        return [] if text is None else [DeviceEvent("warning", text)]

    def _count(self, item: Corrupt | DeviceEvent) -> None:
        if isinstance(item, Corrupt):
            self.counts.corrupt += 1
            self.counts.discarded_bytes += item.discarded
        elif item.kind == "restart":
            self._kept = 0
            self.counts.restarts += 1
            self.clock.feed_restart()
        elif item.kind == "gap":
            lost = item.data.get("lost", 0)
            self.counts.lost += lost if isinstance(lost, int) else 0
        elif item.kind == "info":
            self.info = {**self.info, **item.data}
