"""Computation of the orientation on the gateway, from the raw messages of an x-IMU3.

The magnetometer is slower than the gyroscope and has separate messages. Between two magnetic
messages, the last field is rotated by the angular rate to the time of each inertial message.

Invariant: the output depends only on the messages fed. The module reads no clock and no port.
"""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING

from jointfit_daemon.units import STANDARD_GRAVITY
from jointfit_drivers.gateway_orientation import (
    RawReading,
    RawStamp,
    is_plausible,
    turned_field,
)
from jointfit_protocols.ximu3 import TICK_NS

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples
    from jointfit_protocols.ximu3 import XImu3Data

_DEGREE = radians(1.0)
_OLDEST_US = 1_000_000
"""Age above which a field is not used, us. At this age, the magnetometer was probably switched
off."""


class XImu3RawOrientation:
    """Computes samples from raw messages.

    Parameters
    ----------
    make_samples : callable
        Function that returns a new filter of raw measurements.
    """

    def __init__(self, make_samples: Callable[[], RawSamples]) -> None:
        self._make_samples = make_samples
        self._samples = make_samples()
        self._ticks: int | None = None
        self._first_ticks = 0
        self._measured_ticks = self._field_ticks = 0
        self._field: Vector | None = None

    def forget(self) -> None:
        """Discard the state, because the device and its clock restarted."""
        self.__init__(self._make_samples)  # type: ignore[misc] # the state of a new filter

    def measure_field(self, message: XImu3Data) -> None:
        """Store the field of a magnetic message."""
        x, y, z = message.values
        if self._samples.magnetometer and x * x + y * y + z * z < _STRONGEST:  # False for NaN
            # A hard-iron offset rotates with the sensor, so it is removed before the field is
            # rotated.
            self._field = self._samples.correct_field((x, y, z))
            self._field_ticks = message.ticks
            self._measured_ticks = message.ticks

    def samples(self, message: XImu3Data, arrived_ns: int) -> list[Decoded] | None:
        """Return warnings and samples of an inertial message; None if it is not plausible."""
        ticks = message.ticks
        a, b, c, *force = message.values
        rate = (a * _DEGREE, b * _DEGREE, c * _DEGREE)
        x, y, z = force
        specific = (x * STANDARD_GRAVITY, y * STANDARD_GRAVITY, z * STANDARD_GRAVITY)

        if self._ticks is None:
            self._first_ticks = ticks
        reading = RawReading((ticks - self._first_ticks) * TICK_NS, rate, specific)
        if (self._ticks is not None and ticks <= self._ticks) or not is_plausible(reading):
            return None
        self._ticks = ticks
        reading = reading._replace(magnetic=self._field_at(ticks, rate))
        return self._samples.take(RawStamp(arrived_ns, ticks), reading, field_corrected=True)

    def _field_at(self, ticks: int, rate: Vector) -> Vector | None:
        """Return the field at the time of an inertial message; None if there is no recent field."""
        if self._field is None or ticks - self._measured_ticks > _OLDEST_US:
            return None
        if self._samples.readings_only:  # return each measured field once, unchanged
            field, self._field = self._field, None
            return field
        self._field = turned_field(self._field, rate, (ticks - self._field_ticks) * 1e-6)
        self._field_ticks = ticks
        return self._field


_STRONGEST = 1e4
"""Square of the largest plausible field, in units of the earth's field."""
