"""Decoder of x-IMU3 devices: converts chunks to samples in SI units.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

The stamp of a sample is the arrival of its first byte. On a serial line, this is the arrival of the
chunk minus the duration of the message and of all later bytes in the chunk, at ten bits per byte.
On USB, it is the arrival of the chunk.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, ImuSample, SyncPulse, TickClock
from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_drivers.ximu3._continuity import XImu3Continuity, XImu3Point
from jointfit_drivers.ximu3._device_reports import DeviceReports
from jointfit_drivers.ximu3._orientation import is_orientation, orientation_of
from jointfit_drivers.ximu3._raw_orientation import XImu3RawOrientation
from jointfit_protocols.orientation import OrientationGate, canonical
from jointfit_protocols.ximu3 import (
    MAX_LINE,
    TICK_NS,
    UNKNOWN_KIND,
    DataKind,
    XImu3Codec,
    XImu3Data,
    XImu3Reply,
)

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded, Quaternion
    from jointfit_drivers.ximu3._continuity import XImu3Step
    from jointfit_drivers.ximu3._settings import XImu3Settings
    from jointfit_protocols.corrupt import CorruptBytes

_LATEST_TICKS = 1 << 52
"""Smallest implausible device time, us, equal to 142 years."""
_RATE_TOLERANCE = 0.1
"""Largest relative difference between the measured rate and ``rate_hz`` without a warning."""
_UNUSABLE = {
    DataKind.MATRIX: "rotation matrix is not orthonormal",
    DataKind.EULER: "Euler angles are not finite",
}
_NEWEST = NewestKnown((1,), "the x-IMU3 GUI")
"""Newest supported firmware: the newest version that API 1.9 of the vendor's software can read."""
_OLD_PULSE_US = 10_000_000
"""Largest difference between the time of an edge and the time of the last measurement, us."""
_LONGEST_VERSION = 32


class _Measurement(NamedTuple):
    """A message with a measurement that is not classified yet."""

    message: XImu3Data
    arrived_ns: int
    native: Quaternion | None
    q: Quaternion | None
    """Orientation of the message; None for raw measurements."""


class XImu3Decoder(SerialMessageDecoder[XImu3Data | XImu3Reply]):
    """Decoder of one x-IMU3.

    Parameters
    ----------
    settings : XImu3Settings
        Table of the device in rig.toml.
    """

    def __init__(self, settings: XImu3Settings) -> None:
        super().__init__(XImu3Codec(), Refusals(), settings.line_baud, MAX_LINE)
        self._settings = settings
        self._reports = DeviceReports(settings.world)
        self._newer = NewerFirmwareDetector(_NEWEST)
        make_raw = RawSamples.maker(settings)
        self._raw = None if make_raw is None else XImu3RawOrientation(make_raw)
        self._continuity = XImu3Continuity()
        self._held: _Measurement | None = None
        self._gate = OrientationGate()
        self._q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._last_ticks = 0
        self._norm_checked = self._rate_checked = False

    @property
    def tick_clock(self) -> TickClock:
        """Unit of the device time: microseconds since the device started, without wraps."""
        return TickClock(TICK_NS, None)

    @override
    def flush(self) -> list[Decoded]:
        """Discard an incomplete message, and a measurement that no later message has confirmed."""
        return super().flush() + self._drop_held()

    @override
    def _take(self, message: XImu3Data | XImu3Reply) -> list[Decoded]:
        if message.channel is not None:
            return []
        if isinstance(message, XImu3Data):
            return self._take_data(message)
        world = self._reports.world
        out = self._reports.reply_events(message)
        if message.key == "firmware_version" and message.error is None:
            out += self._newer.take_version(str(message.value)[:_LONGEST_VERSION])
        if self._reports.world != world:  # the continuity of orientations restarts
            self._continuity.forget()
        return out

    @override
    def _take_corrupt(self, found: CorruptBytes) -> list[Decoded]:
        out = super()._take_corrupt(found)
        if found.reason.startswith(UNKNOWN_KIND):
            content = f"messages {found.reason[len(UNKNOWN_KIND) :]}"
            out += self._newer.take_unknown(content, self._stamps.chunk_ns)
        return out

    def _take_data(self, message: XImu3Data) -> list[Decoded]:
        """Return the content of a data message from the device itself."""
        if message.ticks >= _LATEST_TICKS:
            return [self._refusals.refuse(message.size, "device time out of range")]

        kind = message.kind
        if self._raw is not None:
            if kind == DataKind.INERTIAL:
                return self._measure(message, None)
            if kind == DataKind.MAGNETIC:
                self._raw.measure_field(message)
        elif is_orientation(message):
            native = orientation_of(message)
            if native is None:
                return [self._refusals.refuse(message.size, _UNUSABLE[kind])]
            return self._measure(message, native)

        if kind == DataKind.SYNC:
            return self._sync_pulse(message)
        return self._reports.data_events(message)

    def _measure(self, message: XImu3Data, native: Quaternion | None) -> list[Decoded]:
        """Check time and motion of a measurement, and return the samples that it completes."""
        q = None
        if native is not None:
            q = self._gate.admit(canonical(native, self._reports.world))
            if q is None:
                out: list[Decoded] = [
                    self._refusals.refuse(message.size, "quaternion norm is not 1")
                ]
                # Warn once if hardly any quaternion has the norm 1.
                norm = None if self._norm_checked else self._gate.misconfigured_norm
                if norm is not None:
                    self._norm_checked = True
                    text = f"median quaternion norm is {norm:.4g}, expected 1"
                    text += ": order or scale is wrong"
                    data = {"median_norm": norm} if isfinite(norm) else {}
                    out.append(DeviceEvent("warning", text, data))
                return out

        arrived_ns = self._arrival_of(message)
        step = self._continuity.step(XImu3Point(message.ticks, arrived_ns, q))
        return self._continue(step, _Measurement(message, arrived_ns, native, q))

    def _continue(self, step: XImu3Step, measured: _Measurement) -> list[Decoded]:
        """Return the samples of the held measurement, if it is confirmed, and of `measured`."""
        held = self._held
        out = [] if step.confirmed else self._drop_held()
        self._held = measured if step.held else None
        if step.held:
            return out

        if step.restarted and held is not None:
            self._q = (1.0, 0.0, 0.0, 0.0)
            if self._raw is not None:
                self._raw.forget()
            out.append(DeviceEvent("restart", f"device clock restarted at {held.message.ticks} us"))
        out += _gap(step.lost)
        if held is not None and step.confirmed:
            out += self._sample(held)
            out += _gap(step.lost_since)
        out += self._sample(measured)
        return out if self._rate_checked else out + self._rate_warning()

    def _sample(self, measured: _Measurement) -> list[Decoded]:
        """Return the samples that an accepted measurement completes."""
        message, arrived_ns, native, q = measured
        self._last_ticks = message.ticks
        if self._raw is not None:
            found = self._raw.samples(message, arrived_ns)
            return (
                [self._refusals.refuse(message.size, "raw values out of range")]
                if found is None
                else found
            )
        if native is None or q is None:
            return []

        # The sign is aligned with the last sample, because a dropped quaternion may have changed
        # it.
        (a, b, c, d), (w, x, y, z) = self._q, q
        if a * w + b * x + c * y + d * z < 0.0:
            q = (-w, -x, -y, -z)
        self._q = q
        return [ImuSample(arrived_ns, q, native, message.ticks, None)]

    def _sync_pulse(self, message: XImu3Data) -> list[Decoded]:
        """Return the pulse of an edge in the configured direction; empty for other edges."""
        wire, edge = self._settings.sync_wire, message.values[0] != 0.0
        if wire is None or edge != (self._settings.sync_edge == "rising"):
            return []
        if abs(message.ticks - self._last_ticks) > _OLD_PULSE_US:
            return [
                self._refusals.refuse(
                    message.size, "time of an edge is far from the time of the measurements"
                )
            ]
        return [SyncPulse(self._arrival_of(message), message.ticks, wire)]

    def _rate_warning(self) -> list[Decoded]:
        """Return a warning, once, if the rate of the device differs from the configured rate."""
        period_us = self._continuity.period_us
        if period_us is None:
            return []
        self._rate_checked = True
        found_hz, rate_hz = 1e6 / period_us, self._settings.rate_hz
        if abs(found_hz / rate_hz - 1.0) <= _RATE_TOLERANCE:
            return []
        text = f"the device sends at {found_hz:.4g} Hz, rate_hz is {rate_hz:g}: correct one of them"
        return [DeviceEvent("warning", text, {"rate_hz": round(found_hz, 3)})]

    def _drop_held(self) -> list[Decoded]:
        """Reject a measurement that no later message confirmed."""
        held, self._held = self._held, None
        if held is None:
            return []
        reason = "time or motion disagrees with the other messages"
        return [self._refusals.refuse(held.message.size, reason)]


def _gap(lost: int) -> list[Decoded]:
    return [DeviceEvent("gap", f"{lost} messages lost", {"lost": lost})] if lost else []
