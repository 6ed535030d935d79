"""Decoder of WitMotion devices: converts chunks to samples in SI units.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

The frames of one sample follow each other in the order time, acceleration, rate, magnetic field,
quaternion. No frame has a counter. The stamp of a sample is the arrival of its first byte.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt, DeviceEvent, ImuSample, TickClock
from jointfit_drivers.gateway_orientation import RawReading, RawStamp, is_plausible
from jointfit_drivers.newer_firmware import NewerFirmwareDetector
from jointfit_drivers.serial_imu import ArrivalStamps
from jointfit_drivers.witmotion._calendar_time import CalendarTime
from jointfit_protocols.orientation import OrientationGate, canonical
from jointfit_protocols.witmotion import (
    FRAME_BYTES,
    FULL_SCALE,
    TICK_NS,
    WitMotionCodec,
    WitMotionFrame,
    WitMotionFrameKind,
    acceleration_of,
    counts_of,
    rate_of,
    time_of,
)

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples
    from jointfit_protocols.corrupt import CorruptBytes
    from jointfit_protocols.orientation import World

_CHECKED_FRAMES = 100
"""Number of frames after which missing kinds are reported. They contain at least ten samples."""
_OTHER_FRAMES = 3
"""Number of frames with the start bytes 55 61 that prove that the device is a variant without
quaternions. Noise may contain one such frame by chance."""
_MOST_COUNT = 32_700
"""Smallest absolute count of an acceleration or rate that is out of range."""
_SCALE = 1.0 / FULL_SCALE
_TIME = int(WitMotionFrameKind.TIME)
_ACCELERATION = int(WitMotionFrameKind.ACCELERATION)
_RATE = int(WitMotionFrameKind.RATE)
_FIELD = int(WitMotionFrameKind.MAGNETIC_FIELD)
_QUATERNION = int(WitMotionFrameKind.QUATERNION)
_KINDS = frozenset(map(int, WitMotionFrameKind))
OTHER_VARIANT = (
    "it sends frames 55 61 of Bluetooth and SD models, which contain no quaternion: use a model "
    "with serial output 55 59"
)


class WitMotionDecoder:
    """Decoder of one WitMotion device.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a frame is computed; None
        for USB.
    world : World
        World of the quaternion that the device sends.
    inverse : bool
        Whether the quaternion converts world to sensor coordinates.
    device_time : bool
        Whether samples contain the calendar time of the device.
    raw : RawSamples, optional
        Filter that computes orientations from raw measurements; None if the device sends
        orientations.
    """

    def __init__(
        self,
        baud: int | None,
        world: World = "ENU",
        *,
        inverse: bool = False,
        device_time: bool = False,
        raw: RawSamples | None = None,
    ) -> None:
        self.tick_clock = TickClock(TICK_NS, None) if device_time else None
        """Time base of the samples; None if samples are stamped only with their arrival."""
        self._world: World = world
        self._inverse, self._raw = inverse, raw
        self._stamps = ArrivalStamps(baud, FRAME_BYTES)
        self._codec = WitMotionCodec()
        self._gate = OrientationGate()
        self._newer = NewerFirmwareDetector(tool="the WitMotion software")
        self._calendar = CalendarTime()
        self._first_ns = 0
        self._ticks: int | None = None  # time of the current sample
        self._force: bytes | None = None
        self._rate: bytes | None = None
        self._refused = 0
        self._kinds: set[int] = set()
        self._kinds_counted = 0  # processed frames; the codec counts a whole chunk at once
        self._norm_checked = self._kinds_checked = self._other_reported = False

    @property
    def messages(self) -> int:
        """Number of well-formed frames so far."""
        return self._codec.messages - self._refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes so far that belong to no frame or to a rejected frame."""
        return self._codec.discarded + self._refused * FRAME_BYTES

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        if self._codec.pending and self._stamps.is_silent_before(chunk.t_ns, len(chunk.data)):
            out = self.flush()
        self._stamps.start_chunk(chunk.t_ns)
        out += self._take(self._codec.feed(chunk.data))
        if not self._other_reported and self._codec.other_frames >= _OTHER_FRAMES:
            self._other_reported = True
            out.append(DeviceEvent("error", OTHER_VARIANT))
        return out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete frame."""
        return self._take(self._codec.flush())

    def _take(self, found: list[WitMotionFrame | CorruptBytes]) -> list[Decoded]:
        out: list[Decoded] = []
        for event in found:
            if not isinstance(event, WitMotionFrame):
                out.append(Corrupt(event.discarded, event.reason))
                continue
            kind = event.kind
            if kind == _QUATERNION:
                if self._raw is None:
                    out += self._orientation(event)
            elif kind == _TIME:  # the first frame of a sample
                self._first_ns = self._arrival_of(event)
                self._ticks = self._calendar.accept(time_of(event.data), self._first_ns)
                self._force = self._rate = None
            elif kind not in _KINDS:
                out += self._newer.take_unknown(f"frames 0x{kind:02X}", self._stamps.chunk_ns)
            elif self._raw is not None:
                out += self._measurement(event, self._raw)
            if not self._kinds_checked:
                self._kinds.add(kind)
                out += self._missing_kinds()
        return out

    def _arrival_of(self, frame: WitMotionFrame) -> int:
        """Return the arrival of the first byte of `frame`, monotonic ns."""
        return self._stamps.stamp(self._codec.fed - frame.end + FRAME_BYTES)

    def _orientation(self, frame: WitMotionFrame) -> list[Decoded]:
        """Return the sample that a quaternion frame completes."""
        arrival_ns = self._arrival_of(frame)
        if self._ticks is not None:
            arrival_ns = self._first_ns
        ticks = None if self.tick_clock is None else self._ticks
        self._ticks = None  # a time belongs to one quaternion

        a, b, c, d = counts_of(frame.data)
        native = (_SCALE * a, _SCALE * b, _SCALE * c, _SCALE * d)
        q = self._gate.admit(canonical(native, self._world, world_to_sensor=self._inverse))
        out: list[Decoded] = [
            self._refuse("quaternion norm is not 1")
            if q is None
            else ImuSample(arrival_ns, q, native, ticks, None)
        ]

        # Warn once if hardly any quaternion has the norm 1.
        if not self._norm_checked and self._gate.is_decided:
            self._norm_checked, norm = True, self._gate.misconfigured_norm
            if norm is not None:
                text = f"median quaternion norm is {norm:.4g}, expected 1: the scale is wrong"
                out.append(DeviceEvent("warning", text, {"median_norm": norm}))
        return out

    def _measurement(self, frame: WitMotionFrame, raw: RawSamples) -> list[Decoded]:
        """Process a raw frame; return the sample that it completes."""
        if frame.kind == _ACCELERATION:
            self._force = frame.data
            if self._ticks is None:
                self._first_ns = self._arrival_of(frame)
        elif frame.kind == _RATE:
            self._rate = frame.data
            if not raw.magnetometer:
                return self._raw_sample(raw, None)
        elif frame.kind == _FIELD and raw.magnetometer:
            x, y, z, _ = counts_of(frame.data)
            return self._raw_sample(raw, (float(x), float(y), float(z)))
        return []

    def _raw_sample(self, raw: RawSamples, field: Vector | None) -> list[Decoded]:
        force, rate, ticks = self._force, self._rate, self._ticks
        self._force = self._rate = None
        if force is None or rate is None:
            return []  # a frame of this sample was lost

        # The filter needs the time between readings. If the device time is missing, the mean period
        # is used.
        t_ns = self._calendar.reading_ns(ticks, raw.period_ns)
        self._ticks = None
        reading = RawReading(t_ns, rate_of(rate), acceleration_of(force), field)
        if not is_plausible(reading):
            return [self._refuse("raw measurements out of range")]
        clipped = any(
            abs(count) >= _MOST_COUNT for data in (force, rate) for count in counts_of(data)[:3]
        )
        stamp = RawStamp(self._first_ns, ticks if self.tick_clock else None)
        return raw.take(stamp, reading, clipped=clipped)

    def _refuse(self, reason: str) -> Corrupt:
        self._refused += 1
        return Corrupt(FRAME_BYTES, reason, rejected=1)

    def _missing_kinds(self) -> list[Decoded]:
        """Return a warning about required kinds of frames that the device does not send."""
        self._kinds_counted += 1
        if self._kinds_counted < _CHECKED_FRAMES:
            return []
        self._kinds_checked = True
        missing = missing_kinds(self._kinds, self._raw)
        if not missing:
            return []
        text = f"it sends {kind_names(self._kinds)}, but no {kind_names(missing)}"
        return [DeviceEvent("warning", f"{text}: the driver enables these frames at its start")]


def missing_kinds(received: set[int], raw: RawSamples | None) -> set[int]:
    """Return the kinds of frames that a sample requires and that were not received."""
    if raw is None:
        return {_QUATERNION} - received
    return {_ACCELERATION, _RATE, *((_FIELD,) if raw.magnetometer else ())} - received


def kind_names(kinds: set[int]) -> str:
    """Return the names of kinds of frames, for messages."""
    known = set(WitMotionFrameKind)
    names = [
        WitMotionFrameKind(kind).name.lower().replace("_", " ") if kind in known else f"0x{kind:X}"
        for kind in sorted(kinds)
    ]
    return ", ".join(names) or "nothing"
