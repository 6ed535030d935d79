"""Checks of every IMU sample: norm and sign of the quaternion, device time and message counter.

The base classes `SerialDecoder` and `CanDecoder` use these checks. Lost messages, restarts, a wrong
scale, and a rate that differs from the configured rate are reported as device events.

Invariant: the output depends only on the samples added. The module reads no clock and no port.
"""

from __future__ import annotations

from math import isfinite
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.table_samples import RecordContinuity, duration_ns
from jointfit_protocols.orientation import OrientationGate

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded, ImuSample, TickClock


_INTERVALS = 20
"""Number of intervals whose median is the measured period. Lost messages hardly change a median."""
_WRONG_RATE = 0.1
"""Largest relative deviation from the configured rate that causes no warning."""


class _HeldSample(NamedTuple):
    """Sample whose time or counter contradicts the samples before it. The next sample decides."""

    sample: ImuSample
    size: int


class CheckedSamples(Refusals):
    """Checks the samples of one device.

    Parameters
    ----------
    rate_hz : float
        Configured sample rate, Hz.
    tick_clock : TickClock, optional
        Unit and modulus of the device time; None if the device sends no time.
    counts : int, optional
        Number of values of the message counter, for example 256 for one byte; None if the
        counter never wraps.
    tolerance : float
        Largest deviation of the quaternion norm from 1. Use 0.05 if the quaternion components are
        sent as integer thousandths.
    """

    def __init__(
        self,
        rate_hz: float,
        tick_clock: TickClock | None,
        counts: int | None,
        tolerance: float = 0.01,
    ) -> None:
        super().__init__()
        self.tick_clock = tick_clock
        modulus = None if tick_clock is None else tick_clock.modulus
        self._continuity = RecordContinuity(rate_hz, duration_ns(tick_clock), modulus, counts)
        self._gate = OrientationGate(tolerance)
        self._held: _HeldSample | None = None
        self._norm_checked = False
        self._rate_hz, self._tick_ns, self._modulus = rate_hz, duration_ns(tick_clock), modulus
        self._last_ticks: int | None = None
        self._intervals: list[int] = []

    def add(self, sample: ImuSample, size: int) -> list[Decoded]:
        """Return the events and samples that the next sample completes.

        Parameters
        ----------
        sample
            Next sample. Its `q_world_sensor` follows CONVENTIONS.md, but may have any norm and
            sign.
        size
            Number of bytes of the sample's message on the wire.
        """
        if sample.ticks is None and sample.counter is None:
            return self._admit(sample, size)

        step = self._continuity.take(sample.ticks, sample.counter, sample.arrival_ns)
        held = self._held
        if held is not None and step.confirmed:
            self._held = None
            out: list[Decoded] = []
            if step.restarted:
                self._gate.forget()
                ticks = held.sample.ticks
                clock = ": its counter began again" if ticks is None else f" at device time {ticks}"
                out.append(DeviceEvent("restart", f"device restarted{clock}"))
            out += self._admit(*held)
            lost = step.lost_since
        else:
            out = self.flush()  # `sample` does not confirm the held sample
            lost = step.lost

        # A single sample cannot prove a restart, because some corrupt messages pass a checksum.
        if step.held:
            self._held = _HeldSample(sample, size)
            return out
        if lost:
            out.append(DeviceEvent("gap", f"{lost} samples lost", {"lost": lost}))
        return out + self._admit(sample, size)

    @override
    def flush(self) -> list[Decoded]:
        """Reject the held sample, which no later sample confirmed, and return the events."""
        held, self._held = self._held, None
        if held is None:
            return []
        return [self.refuse(held.size, "time and counter disagree with the other samples")]

    def _admit(self, sample: ImuSample, size: int) -> list[Decoded]:
        """Return the sample with a unit quaternion, or the event of its rejection, and warnings."""
        q = self._gate.admit(sample.q_world_sensor)
        if q is not None:
            checked = sample._replace(q_world_sensor=q)
            if sample.ticks is None or len(self._intervals) == _INTERVALS:
                return [checked]
            return [checked, *self._rate_warning(sample.ticks)]

        # Warn once if hardly any of the first quaternions has the norm 1.
        out: list[Decoded] = [self.refuse(size, "quaternion norm is not 1")]
        norm = None if self._norm_checked else self._gate.misconfigured_norm
        if norm is not None:
            self._norm_checked = True
            text = f"median quaternion norm is {norm:.4g}, expected 1: byte order or scale is wrong"
            data = {"median_norm": norm} if isfinite(norm) else {}
            out.append(DeviceEvent("warning", text, data))
        return out

    def _rate_warning(self, ticks: int) -> list[Decoded]:
        """Return a warning, once, if the device time of the first samples contradicts `rate_hz`."""
        last, self._last_ticks = self._last_ticks, ticks
        if last is None:
            return []
        passed = ticks - last if self._modulus is None else (ticks - last) % self._modulus
        if passed > 0:  # not positive: the device restarted
            self._intervals.append(passed)
        if len(self._intervals) < _INTERVALS:
            return []

        found_hz = 1e9 / (median(self._intervals) * self._tick_ns)
        if abs(found_hz - self._rate_hz) <= _WRONG_RATE * self._rate_hz:
            return []
        text = (
            f"the device time shows {found_hz:.4g} samples per second, expected "
            f"{self._rate_hz:g}: set rate_hz = {found_hz:.4g}, or change the rate of the device"
        )
        return [DeviceEvent("warning", text, {"rate_hz": round(found_hz, 2)})]
