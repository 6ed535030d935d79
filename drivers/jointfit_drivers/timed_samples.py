"""Samples of an IMU that sends device time in nanoseconds and no message counter.

`TimedSamples` checks the time of each reading, the norm of its quaternion, and the plausibility of
its raw measurements. It reports losses, restarts and faults as device events.

Invariant: the output depends only on the readings added. The module reads no clock and no port.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.gateway_orientation import RawReading, RawStamp, is_plausible
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.time_continuity import TimeContinuity
from jointfit_protocols.orientation import OrientationGate, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples


class RawVectors(NamedTuple):
    """Raw measurements in sensor axes."""

    rate: Vector
    """Angular rate, rad/s."""
    force: Vector
    """Specific force, m/s^2."""
    magnetic: Vector | None = None
    """Magnetic field in any unit; None if not measured."""


class TimedReading(NamedTuple):
    """Content of one message: an orientation or raw measurements.

    An invalid message contains neither of them.
    """

    size: int
    """Length on the wire, bytes."""
    arrival_ns: int
    ticks: int | None
    """Device time, ns; None if the message contains no device time."""
    q_world_sensor: Quaternion | None = None
    """Orientation q_world_sensor in an ENU world, with any norm."""
    q_native: Quaternion | None = None
    """Quaternion as sent by the device."""
    status: int | None = None
    raw: RawVectors | None = None


class TimedSamples(Refusals):
    """Computes the samples of one device from its readings.

    Parameters
    ----------
    make_raw : callable, optional
        Function that returns a new filter of raw measurements; None if the device sends
        orientations.
    untimed_remedy : str
        Remedy in the warning about readings without device time.
    """

    def __init__(self, make_raw: Callable[[], RawSamples] | None, untimed_remedy: str) -> None:
        super().__init__()
        self._make_raw = make_raw
        self._raw = None if make_raw is None else make_raw()
        self._untimed_remedy = untimed_remedy
        self._continuity = TimeContinuity()
        self._held: TimedReading | None = None
        self._gate = OrientationGate()
        self._raw_ns: int | None = None
        self._timed = self._untimed = self._norm_checked = False

    def add(self, reading: TimedReading) -> list[Decoded]:
        """Return the events and samples that a reading completes."""
        if reading.ticks is None:
            out: list[Decoded] = []
            if not self._untimed:
                self._untimed = True
                text = f"measurement without device time in its message: {self._untimed_remedy}"
                out.append(DeviceEvent("warning", text))

            # An orientation without device time is stamped with its arrival. It is rejected if
            # earlier readings have a device time. Raw measurements without device time are always
            # rejected.
            if self._timed or self._make_raw is not None:
                return [*out, self.refuse(reading.size, "measurement without device time")]
            return out + self._samples(reading)

        self._timed = True
        step = self._continuity.add(reading.ticks, reading.arrival_ns)
        held = self._held
        if step.restarted and held is not None:
            self._held = None
            self._gate.forget()
            if self._make_raw is not None:
                self._raw, self._raw_ns = self._make_raw(), None
            text = f"device clock restarted at {(held.ticks or 0) * 1e-9:.3f} s"
            restart = DeviceEvent("restart", text)
            return [restart, *self._samples(held), *self._samples(reading)]

        out = self.flush()
        if step.held:
            self._held = reading
            return out
        if step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} messages lost", {"lost": step.lost}))
        return out + self._samples(reading)

    @override
    def flush(self) -> list[Decoded]:
        """Reject the held reading, which no later reading confirmed, and return the events."""
        held, self._held = self._held, None
        return [] if held is None else [self.refuse(held.size, "time disagrees with the others")]

    def _samples(self, reading: TimedReading) -> list[Decoded]:
        """Return the samples and events of an accepted reading."""
        if reading.raw is not None and self._raw is not None:
            rate, force, magnetic = reading.raw
            ticks = reading.ticks or 0
            field = magnetic if self._raw.magnetometer else None
            measured = RawReading(ticks, rate, force, field)
            if ticks == self._raw_ns:
                reason = "raw measurements with the time of the previous ones"
                return [self.refuse(reading.size, reason)]
            if not is_plausible(measured):
                return [self.refuse(reading.size, "raw measurements out of range")]
            self._raw_ns = ticks
            return self._raw.take(RawStamp(reading.arrival_ns, ticks), measured)
        if reading.q_world_sensor is None:
            return []

        out: list[Decoded] = []
        q = self._gate.admit(reading.q_world_sensor)
        if q is None:
            out.append(self.refuse(reading.size, "quaternion norm is not 1"))
        else:
            native = reading.q_native or reading.q_world_sensor
            out.append(
                ImuSample(reading.arrival_ns, q, native, reading.ticks, None, reading.status)
            )

        # Warn once if hardly any quaternion has the norm 1.
        if not self._norm_checked:
            self._norm_checked, norm = self._gate.is_decided, self._gate.misconfigured_norm
            if norm is not None:
                text = f"median quaternion norm is {norm:.4g}, expected 1"
                text += ": byte order or scale is not as documented"
                data = {"median_norm": norm} if isfinite(norm) else {}
                out.append(DeviceEvent("warning", text, data))
        return out
