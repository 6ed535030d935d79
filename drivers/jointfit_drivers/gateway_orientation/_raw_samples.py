"""Samples of an IMU whose orientation the gateway computes from raw measurements.

`RawSamples` contains the orientation filter. It reports the state of the filter, gaps and
saturation as device events. Drivers convert the measurements of their devices to a `RawReading`
with a `RawStamp`.

Invariant: the output depends only on the readings fed. The module reads no clock and no port.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Self

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.gateway_orientation._filter import (
    LONGEST_SETTLE_S,
    FilterOutput,
    GatewayOrientation,
    RawReading,
)
from jointfit_drivers.gateway_orientation._sensor_correction import SensorCorrection

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Decoded, Quaternion, Vector
    from jointfit_drivers.gateway_orientation._settings import GatewaySettings

_REPORT_NS, _SOON_NS = 10_000_000_000, 1_000_000_000
"""Intervals between two events with the state of the filter, ns: without a change of the state, and
the shortest interval if the state has changed."""
FAST = 5.0
"""Angular rate below which no gyroscope saturates, rad/s."""
_NEW_HEADING = (
    "orientation from gyroscope and accelerometer started with an arbitrary heading: "
    "repeat the static pose"
)


_IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


class RawStamp(NamedTuple):
    """Fields of a raw message other than its measurements."""

    arrival_ns: int
    ticks: int | None
    counter: int | None = None
    status: int | None = None


class RawSamples:
    """Computes samples from raw readings.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz.
    magnetometer : bool
        Whether the heading comes from the magnetometer.
    settle_s : float
        Longest time without output after a start of the filter, s.
    correction : SensorCorrection, optional
        Correction of the readings; None if the sensor is not calibrated.
    readings_only : bool
        Whether uncorrected readings are returned without orientation, for a sensor calibration.
    """

    def __init__(
        self,
        rate_hz: float,
        *,
        magnetometer: bool,
        settle_s: float = LONGEST_SETTLE_S,
        correction: SensorCorrection | None = None,
        readings_only: bool = False,
    ) -> None:
        self.readings_only = readings_only
        """Whether uncorrected readings are returned."""
        self._correction = None if readings_only else correction
        self.magnetometer = magnetometer
        """Whether the heading comes from the magnetometer."""
        self._filter = GatewayOrientation(rate_hz, magnetometer=magnetometer, settle_s=settle_s)
        self._waiting: tuple[RawStamp, RawReading] | None = None
        self._t_ns = 0
        self._reported_ns, self._reported = -_REPORT_NS, (False, False, False)
        self._clipped_ns = -_REPORT_NS
        self._rate: Vector = (0.0, 0.0, 0.0)
        self._started = False

    @classmethod
    def of(cls, settings: GatewaySettings) -> Self:
        """Return a `RawSamples` for a sensor with these settings."""
        calibration = settings.sensor_calibration
        return cls(
            settings.rate_hz,
            magnetometer=settings.magnetometer,
            settle_s=settings.settle_s,
            correction=None if calibration is None else SensorCorrection(calibration),
            readings_only=settings.readings_only,
        )

    @classmethod
    def maker(cls, settings: GatewaySettings) -> Callable[[], Self] | None:
        """Return a function that creates a `RawSamples`; None if the device sends orientations."""
        return partial(cls.of, settings) if settings.orientation == "gateway" else None

    @property
    def period_ns(self) -> float:
        """Mean interval of the readings so far, ns."""
        return self._filter.period_ns

    def correct_field(self, field: Vector) -> Vector:
        """Return a magnetic field, corrected if the sensor is calibrated."""
        return field if self._correction is None else self._correction.correct_field(field)

    def take(
        self,
        stamp: RawStamp,
        reading: RawReading,
        *,
        clipped: bool = False,
        field_corrected: bool = False,
    ) -> list[Decoded]:
        """Return the warnings and samples that a plausible reading completes.

        Parameters
        ----------
        stamp
            Arrival, device time and status of the message.
        reading
            Measurements of the message. Their time must be later than the time of the previous
            reading.
        clipped
            Whether the driver found that a measurement is out of range.
        field_corrected
            Whether `correct_field` was already applied to the magnetic field.
        """
        self._t_ns = reading.t_ns
        if self.readings_only:
            found = self._warnings(stamp, reading, clipped=clipped, restarted=False, missing=0)
            arrival_ns, ticks, counter, status = stamp
            vectors = (reading.rate, reading.force, reading.magnetic)
            sample = ImuSample(arrival_ns, _IDENTITY, _IDENTITY, ticks, counter, status, *vectors)
            return [*found, sample]
        if self._correction is not None:
            reading = self._correction.correct(reading, field=not field_corrected)
        step = self._filter.take(reading)
        out = self._warnings(
            stamp, reading, clipped=clipped, restarted=step.restarted, missing=step.missing
        )

        first, self._waiting = self._waiting, (stamp, reading)
        if len(step.oriented) > 1 and first is not None:
            out.append(_sample(*first, step.oriented[0]))
        if step.oriented:
            out += self._state_events()
            out.append(_sample(stamp, reading, step.oriented[-1]))
        return out

    def _warnings(
        self, stamp: RawStamp, reading: RawReading, *, clipped: bool, restarted: bool, missing: int
    ) -> list[Decoded]:
        """Return warnings about missing measurements and saturation."""
        out: list[Decoded] = []
        if restarted:
            text = (
                f"{missing} measurements missing: orientation filter restarted, heading uncertain"
            )
            out.append(DeviceEvent("warning", text, {"missing": missing}))

        # Some devices do not report saturation. It is therefore also detected from repeated values:
        # because of noise, a high rate repeats exactly only at the end of the gyroscope's range.
        before, self._rate = self._rate, reading.rate
        pairs = zip(self._rate, before, strict=True)
        clipped |= any(now == then and abs(now) > FAST for now, then in pairs)
        if clipped and self._t_ns - self._clipped_ns >= _REPORT_NS:
            self._clipped_ns = self._t_ns
            text = "a measurement was out of range: heading is uncertain until the next static pose"
            out.append(DeviceEvent("warning", text, {"status": stamp.status}))
        return out

    def _state_events(self) -> list[Decoded]:
        """Return the event with the state of the filter, if its interval has passed.

        Without magnetometer, the first call also returns a warning about the arbitrary heading.
        """
        out: list[Decoded] = []
        if not self._started and not self.magnetometer:
            out.append(DeviceEvent("warning", _NEW_HEADING))
        self._started = True

        since_ns = self._t_ns - self._reported_ns
        if since_ns < _SOON_NS:
            return out

        state = self._filter.state
        if state is None or (
            since_ns < _REPORT_NS
            and (state.rest, state.disturbed, state.converging) == self._reported
        ):
            return out
        self._reported_ns = self._t_ns
        self._reported = (state.rest, state.disturbed, state.converging)

        data: dict[str, object] = {
            "rest": state.rest,
            "bias_rad_s": [round(value, 7) for value in state.bias],
            "bias_sd_rad_s": round(state.bias_sd, 7),
            "magnetometer": self.magnetometer,
            "disturbed": state.disturbed,
            "settled": not self._filter.settling,
            "converging": state.converging,
            "period_ms": round(self._filter.period_ns * 1e-6, 6),
        }
        if self._correction is not None:
            data["sensor_calibration"] = self._correction.date
        out.append(DeviceEvent("info", "orientation filter", {"orientation_filter": data}))
        return out


def _sample(
    stamp: RawStamp,
    reading: RawReading,
    oriented: FilterOutput,
) -> ImuSample:
    q = oriented.q_world_sensor
    arrival_ns, ticks, counter, status = stamp
    # The measured rate may be a mean over the previous interval, so the sample contains no rate.
    rate, force, field = None, reading.force, reading.magnetic
    return ImuSample(arrival_ns, q, q, ticks, counter, status, rate, force, field)
