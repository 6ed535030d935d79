"""Computation of the orientation on the gateway, from the raw measurements of an Xbus device.

The angular rate is sent as RateOfTurn or DeltaQ, and the specific force as Acceleration or DeltaV,
all in sensor axes. The increments DeltaQ and DeltaV are divided by the mean interval of the samples
in device time. When the filter has settled, every complete message yields one sample.

Invariant: the output depends only on the messages fed. The module reads no clock and no port.
"""

from __future__ import annotations

from math import atan2, sqrt
from typing import TYPE_CHECKING, cast

from jointfit_drivers.gateway_orientation import RawReading, RawStamp, is_plausible
from jointfit_protocols.xbus.configuration import TICK_NS
from jointfit_protocols.xbus.mtdata2 import CLIPPING, Item

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.model import Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples

RATES = (int(Item.RATE_OF_TURN), int(Item.DELTA_Q))
FORCES = (int(Item.ACCELERATION), int(Item.DELTA_V))
FIELD = int(Item.MAGNETIC_FIELD)
RAW = frozenset((*RATES, *FORCES, FIELD))
_TINY = 1e-12
"""Norm of the vector part of a quaternion below which its angle is computed by the series 2 |v|."""


class RawOrientation:
    """Computes samples from raw data items.

    Parameters
    ----------
    make_samples : callable
        Function that returns a new filter of raw measurements.
    """

    def __init__(self, make_samples: Callable[[], RawSamples]) -> None:
        self._make_samples = make_samples
        self._samples = make_samples()
        self._ticks: int | None = None
        self._t_ns = 0

    def forget(self) -> None:
        """Discard the state, because the device and its clock restarted."""
        self.__init__(self._make_samples)  # type: ignore[misc] # the state of a new filter

    def is_complete(self, values: Mapping[int, object]) -> bool:
        """Return whether a message contains an angular rate and a specific force."""
        has_rate = RATES[0] in values or RATES[1] in values
        return has_rate and (FORCES[0] in values or FORCES[1] in values)

    def samples(
        self, stamp: RawStamp, values: Mapping[int, object], modulus: int
    ) -> list[Decoded] | None:
        """Return warnings and samples of a complete message; None if it is not plausible.

        A message with the time of the previous message is not plausible either.
        """
        ticks = stamp.ticks
        if ticks is None or ticks == self._ticks:
            return None
        passed = 0 if self._ticks is None else (ticks - self._ticks) % modulus
        period_s = self._samples.period_ns * 1e-9

        # Increments are divided by the interval. Rates and increments are both in sensor axes.
        rate, force = values.get(RATES[0]), values.get(FORCES[0])
        if rate is None:
            turn = cast("tuple[float, float, float, float]", values[RATES[1]])
            rate = _scale(_rotation_vector(turn), 1.0 / period_s)
        if force is None:
            force = _scale(cast("Vector", values[FORCES[1]]), 1.0 / period_s)
        field = values.get(FIELD) if self._samples.magnetometer else None
        vectors = (cast("Vector", rate), cast("Vector", force), cast("Vector | None", field))
        reading = RawReading(self._t_ns + passed * TICK_NS, *vectors)
        if not is_plausible(reading):
            return None

        self._ticks, self._t_ns = ticks, reading.t_ns
        clipped = stamp.status is not None and bool(stamp.status & CLIPPING)
        return self._samples.take(stamp, reading, clipped=clipped)


def _rotation_vector(q: tuple[float, float, float, float]) -> Vector:
    """Return the rotation vector 2 log(q), rad, of norm at most pi."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    length = sqrt(x * x + y * y + z * z)
    scale = 2.0 * atan2(length, w) / length if length > _TINY else 2.0
    return (scale * x, scale * y, scale * z)


def _scale(vector: Vector, scale: float) -> Vector:
    return (vector[0] * scale, vector[1] * scale, vector[2] * scale)
