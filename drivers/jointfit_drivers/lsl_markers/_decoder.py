"""Decoder of LSL streams: converts chunks to optical frames and clock comparisons (`ClockEcho`).

Each sample of the stream becomes one frame. A position counts as occluded if a coordinate is not
finite, if all three coordinates are exactly zero, or if its confidence is not positive. Some
programs stamp samples with the time of their cameras instead of the LSL clock. The decoder
therefore checks the stamps. If the stamps are times of the LSL clock, the decoder returns each
comparison of the sender's LSL clock with the host clock as a `ClockEcho`.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no stream.
"""

from __future__ import annotations

from math import isfinite, isnan
from typing import TYPE_CHECKING

from jointfit_daemon.model import ClockEcho, Corrupt, DeviceEvent, MocapFrame, TickClock
from jointfit_daemon.units import NS_PER_S
from jointfit_drivers.lsl_markers._channels import stream_layout
from jointfit_drivers.motion_capture import (
    ABSENT,
    NO_POSITION,
    UnitCheck,
    bind_columns,
    is_near,
    renew_columns,
    rows_array,
    unit_quaternion,
    wanted_names,
    world_rotation,
)
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.lsl import LslCodec, RoundTrip, Samples

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded, Quaternion, Vector
    from jointfit_drivers.lsl_markers._channels import Columns, StreamLayout
    from jointfit_drivers.lsl_markers._settings import LslMarkersSettings
    from jointfit_drivers.motion_capture import ColumnBinding
    from jointfit_protocols.lsl import StreamDescription

_CLOCK = TickClock(1, None)
_LATEST_S = 9e9
"""Largest time stamp, s, whose value in nanoseconds fits into 64 bits."""
_BACKWARDS_NS = NS_PER_S
"""Smallest decrease of the stamps that shows a restart of the sender, ns."""
_GAP_PERIODS, _LEAST_GAP_NS = 5, 100_000_000
"""Largest step between two stamps of a regular stream, in periods and in ns. If a step exceeds both
values, samples were lost. If a program stamps samples at transmission, the stamps have a jitter of
several periods."""
_REPEATED = 50
"""Number of repeated stamps at which a warning is returned if most stamps are repeated. A stamp is
repeated if it equals the stamp of the previous sample."""
_EARLY_NS, _LATE_NS = 500_000_000, 10 * NS_PER_S
"""Largest times by which a stamp on the LSL clock may be later and earlier than its arrival, ns."""


class LslMarkersDecoder:
    """Decoder of one stream.

    Parameters
    ----------
    settings : LslMarkersSettings
        The ``[mocap]`` table with names, unit, up axis and clock.
    """

    def __init__(self, settings: LslMarkersSettings) -> None:
        self._settings = settings
        self._codec = LslCodec()
        self._wanted_markers, self._wanted_bodies = wanted_names(settings)
        self._place, self._turn = world_rotation(settings.up_axis)
        self._description: StreamDescription | None = None
        self._layout: StreamLayout | None = None
        self._described: bytes | None = None
        self._binding: ColumnBinding | None = None
        self._unit_check = UnitCheck("m")
        self._number = 0
        self._last: tuple[int, int] | None = None  # stamp and arrival of the last sample, ns
        self._trip: RoundTrip | None = None
        self._on_lsl_clock: bool | None = None  # None: not known yet
        self._zeros_reported = False
        self._steps, self._repeated = 0, 0  # numbers of all steps of the stamps, and of zero steps
        self.unpublished = 0
        """Number of chunks with samples that arrived before the description of the stream."""
        self.suspicious = 0
        """Number of samples, positions, poses and clock comparisons rejected as implausible."""

    @property
    def tick_clock(self) -> TickClock:
        """Clock of the stamps, in ns."""
        return _CLOCK

    @property
    def messages(self) -> int:
        """Number of samples and other well-formed chunks so far."""
        return self._codec.messages

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes so far in malformed chunks."""
        return self._codec.discarded

    @property
    def description(self) -> tuple[bytes, ...]:
        """Chunk with the newest description of the stream; empty before the first description."""
        return () if self._described is None else (self._described,)

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the frames, clock comparisons and events of `chunk`; never raise."""
        out: list[Decoded] = []
        for message in self._codec.feed(chunk.data):
            match message:
                case Samples():
                    self._samples(message, chunk.t_ns, out)
                case RoundTrip():
                    self._round_trip(message, out)
                case CorruptBytes():
                    out.append(Corrupt(message.discarded, message.reason))
                case _:
                    self._described = chunk.data
                    self._bind_channels(message, out)
        self.unpublished = self._codec.undescribed
        return out

    def flush(self) -> list[Decoded]:
        """Return an empty list, because chunks are always complete."""
        return []

    # --- description --------------------------------------------------------------------------

    def _bind_channels(self, description: StreamDescription, out: list[Decoded]) -> None:
        """Assign the channels of a new connection to the names in rig.toml."""
        before, self._description = self._description, description
        layout = stream_layout(description, self._settings)
        facts: dict[str, object] = {
            "stream": description.name,
            "host": description.hostname,
            "source_id": description.source_id,
            "channels": description.channel_count,
            "rate_hz": description.rate_hz,
            "unit": layout.unit,
            "compensated_lag_s": description.compensated_lag_s,
        }
        maker = f"{description.manufacturer} {description.model}".strip()
        text = f"LSL stream {description.name!r} of {description.hostname or 'unknown host'}"
        out.append(DeviceEvent("info", f"{text}, {maker}" if maker else text, facts))
        if before is not None and before.channel_count != description.channel_count:
            out.append(
                DeviceEvent(
                    "warning",
                    f"the stream had {before.channel_count} channels and has "
                    f"{description.channel_count} since the new connection: check the markers "
                    "and bodies that the camera software streams",
                    {"before": before.channel_count, "now": description.channel_count},
                )
            )
        out += [DeviceEvent("warning", text) for text in layout.warnings]

        bound = bind_columns(
            layout.markers, layout.bodies, self._wanted_markers, self._wanted_bodies
        )
        self._binding, events = renew_columns(self._binding, bound, self._codec.undescribed)
        out += events
        self._layout = layout
        self._unit_check = UnitCheck(layout.unit)
        self._trip, self._on_lsl_clock = None, None
        self._steps, self._repeated = 0, 0

    # --- time ---------------------------------------------------------------------------------

    def _round_trip(self, trip: RoundTrip, out: list[Decoded]) -> None:
        """Append the `ClockEcho` of a comparison of the clocks."""
        if not abs(trip.remote_s) < _LATEST_S or trip.received_ns < trip.sent_ns:
            self.suspicious += 1
            return
        self._trip = trip
        if self._on_lsl_clock is None and self._last is not None:
            self._check_clock(*self._last, out)
        elif self._on_lsl_clock:
            out.append(_echo(trip))

    def _check_clock(self, stamp_ns: int, arrival_ns: int, out: list[Decoded]) -> None:
        """Decide after a connection or a restart whether the stamps are on the LSL clock."""
        trip = self._trip
        if self._on_lsl_clock is not None or trip is None or self._settings.time == "sender":
            return

        host_ns = (
            (trip.sent_ns + trip.received_ns) // 2 + stamp_ns - round(trip.remote_s * NS_PER_S)
        )
        delay_ns = arrival_ns - host_ns

        self._on_lsl_clock = -_EARLY_NS <= delay_ns <= _LATE_NS
        if self._on_lsl_clock:
            out.append(_echo(trip))
            return
        out.append(
            DeviceEvent(
                "warning",
                f"the time stamps differ by {delay_ns / NS_PER_S:.1f} s from the LSL clock: the "
                "program stamps its samples with another clock, and only their arrival times are "
                'used; set time = "sender" in [mocap]',
                {"difference_s": delay_ns / NS_PER_S},
            )
        )

    def _check_step(self, stamp_ns: int, out: list[Decoded]) -> None:
        """Report lost samples of a regular stream, repeated stamps, and a restart of the sender."""
        if self._last is None or self._description is None:
            return
        step_ns, rate_hz = stamp_ns - self._last[0], self._description.rate_hz
        if step_ns < -_BACKWARDS_NS:
            text = f"clock of the sender stepped by {step_ns / NS_PER_S:+.3f} s"
            out.append(DeviceEvent("restart", text, {"step_s": step_ns / NS_PER_S}))
            self._on_lsl_clock = None
        self._count_repeated(step_ns, out)
        if rate_hz and step_ns > max(_GAP_PERIODS * NS_PER_S / rate_hz, _LEAST_GAP_NS):
            lost = round(step_ns * rate_hz / NS_PER_S) - 1
            out.append(DeviceEvent("gap", f"{lost} samples lost", {"lost": lost}))

    def _count_repeated(self, step_ns: int, out: list[Decoded]) -> None:
        """Report once per connection that most samples have the stamp of the previous sample."""
        self._steps += 1
        self._repeated += step_ns == 0
        if step_ns == 0 and self._repeated == _REPEATED and 2 * self._repeated > self._steps:
            text = (
                f"{self._repeated} of {self._steps} samples have the time stamp of the previous "
                "sample and count as duplicates, because the program sends several samples at "
                "once: set the nominal rate of the stream in the program, or send each sample "
                "separately"
            )
            out.append(DeviceEvent("warning", text))

    # --- samples ------------------------------------------------------------------------------

    def _samples(self, samples: Samples, arrival_ns: int, out: list[Decoded]) -> None:
        layout, binding = self._layout, self._binding
        if layout is None or binding is None:
            return
        for stamp_s, values in zip(samples.stamps_s, samples.values, strict=True):
            if not abs(stamp_s) < _LATEST_S:
                self.suspicious += 1
                continue
            stamp_ns = round(stamp_s * NS_PER_S)
            self._check_step(stamp_ns, out)
            self._last = (stamp_ns, arrival_ns)
            self._check_clock(stamp_ns, arrival_ns, out)

            columns = layout.columns
            markers = [self._position(values, columns[key], out) for key in binding.markers]
            poses = [self._pose(values, columns[key], out) for key in binding.bodies]
            self._number += 1
            out.append(
                MocapFrame(
                    arrival_ns,
                    self._number,
                    stamp_ns,
                    binding.layout,
                    rows_array(markers, 3),
                    rows_array([position for position, _ in poses], 3),
                    rows_array([turn for _, turn in poses], 4),
                    counted=False,
                )
            )

    def _position(self, values: tuple[float, ...], columns: Columns, out: list[Decoded]) -> Vector:
        """Return a position with z up, m; NaN if occluded."""
        i, j, k = columns.position
        x, y, z = values[i], values[j], values[k]
        if columns.confidence is not None and not values[columns.confidence] > 0.0:
            return NO_POSITION
        if x == y == z == 0.0:
            if not self._zeros_reported:
                self._zeros_reported = True
                text = "positions of exactly 0, 0, 0 are not used: the program writes these zeros"
                out.append(DeviceEvent("info", f"{text} for occluded markers"))
            return NO_POSITION
        if not (isfinite(x) and isfinite(y) and isfinite(z)):
            return NO_POSITION

        if (warning := self._unit_check.feed(x, y, z)) is not None:
            out.append(DeviceEvent("warning", warning))
        scale = self._layout.scale_m if self._layout is not None else 1.0
        x, y, z = scale * x, scale * y, scale * z
        if not is_near(x, y, z):
            self.suspicious += 1
            return NO_POSITION
        return self._place(x, y, z)

    def _pose(
        self, values: tuple[float, ...], columns: Columns, out: list[Decoded]
    ) -> tuple[Vector, Quaternion]:
        """Return position and orientation of a body with z up; both are NaN if it is occluded."""
        position = self._position(values, columns, out)
        if columns.orientation is None or position is NO_POSITION:
            return ABSENT
        w, x, y, z = (values[index] for index in columns.orientation)
        q = unit_quaternion(w, x, y, z)
        if q is None:
            self.suspicious += not isnan(w)
            return ABSENT
        return position, self._turn(*q)


def _echo(trip: RoundTrip) -> ClockEcho:
    return ClockEcho(trip.sent_ns, trip.received_ns, round(trip.remote_s * NS_PER_S))
