"""Orientation on the gateway from the raw measurements of an Xbus device.

Angular rate arrives as RateOfTurn or DeltaQ, specific force as Acceleration or DeltaV, all in
sensor axes. Increments are divided by the mean interval of the device clock. Every complete message
yields one sample once the filter has settled.

Invariant: the output depends only on the messages fed; no clock and no port is read.
"""

from __future__ import annotations

from math import atan2, sqrt
from typing import TYPE_CHECKING, NamedTuple, cast

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.gateway_orientation import (
    LONGEST_SETTLE_S,
    FilterOutput,
    GatewayOrientation,
    RawReading,
    is_plausible,
)
from jointfit_protocols.xbus.configuration import TICK_NS
from jointfit_protocols.xbus.mtdata2 import CLIPPING, Item

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Decoded, Vector

RATES = (int(Item.RATE_OF_TURN), int(Item.DELTA_Q))
FORCES = (int(Item.ACCELERATION), int(Item.DELTA_V))
FIELD = int(Item.MAGNETIC_FIELD)
RAW = frozenset((*RATES, *FORCES, FIELD))
_REPORT_NS, _SOON_NS = 10_000_000_000, 1_000_000_000
"""Period, ns, of the filter's state events: in general, and after a change."""
_TINY = 1e-12
"""Norm of the vector part of a quaternion below which its angle is computed by the series 2 |v|."""
FAST = 5.0
"""Angular rate, rad/s, below which no gyroscope saturates."""
_NEW_HEADING = (
    "orientation from gyroscope and accelerometer started with an arbitrary heading: "
    "repeat the static pose"
)


class RawMessage(NamedTuple):
    """Fields of a raw MTData2 besides its measurements."""

    arrival_ns: int
    ticks: int
    counter: int | None
    status: int | None


class RawOrientation:
    """Computes samples from raw items.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz.
    magnetometer : bool
        Whether heading comes from the magnetometer.
    settle_s : float
        Longest time without output after the start of the filter, s.
    """

    def __init__(
        self, rate_hz: float, *, magnetometer: bool, settle_s: float = LONGEST_SETTLE_S
    ) -> None:
        self._made = (rate_hz, magnetometer, settle_s)
        self._filter = GatewayOrientation(rate_hz, magnetometer=magnetometer, settle_s=settle_s)
        self._waiting: tuple[RawMessage, RawReading] | None = None
        self._ticks: int | None = None
        self._t_ns = 0
        self._reported_ns, self._reported = -_REPORT_NS, (False, False, False)
        self._clipped_ns = -_REPORT_NS
        self._rate: Vector = (0.0, 0.0, 0.0)
        self._started = False

    def forget(self) -> None:
        """Start again: the device and its clock restarted."""
        rate_hz, magnetometer, settle_s = self._made
        self.__init__(  # type: ignore[misc] # the state of a new filter
            rate_hz, magnetometer=magnetometer, settle_s=settle_s
        )

    def is_complete(self, values: Mapping[int, object]) -> bool:
        """Return whether a message contains an angular rate and a specific force."""
        has_rate = RATES[0] in values or RATES[1] in values
        return has_rate and (FORCES[0] in values or FORCES[1] in values)

    def samples(
        self, message: RawMessage, values: Mapping[int, object], modulus: int
    ) -> list[Decoded] | None:
        """Return warnings and samples of a complete message; None if it is not plausible."""
        passed = 0 if self._ticks is None else (message.ticks - self._ticks) % modulus
        period_s = self._filter.period_ns * 1e-9

        # Increments are divided by the interval; both forms are in sensor axes.
        rate, force = values.get(RATES[0]), values.get(FORCES[0])
        if rate is None:
            turn = cast("tuple[float, float, float, float]", values[RATES[1]])
            rate = _scaled(_rotation_vector(turn), 1.0 / period_s)
        if force is None:
            force = _scaled(cast("Vector", values[FORCES[1]]), 1.0 / period_s)
        field = values.get(FIELD) if self._made[1] else None
        vectors = (cast("Vector", rate), cast("Vector", force), cast("Vector | None", field))
        reading = RawReading(self._t_ns + passed * TICK_NS, *vectors)
        if message.ticks == self._ticks or not is_plausible(reading):
            return None

        self._ticks, self._t_ns = message.ticks, reading.t_ns
        step = self._filter.take(reading)
        out = self._warnings(message, values, restarted=step.restarted, missing=step.missing)

        first, self._waiting = self._waiting, (message, reading)
        if len(step.oriented) > 1 and first is not None:
            out.append(_sample(*first, step.oriented[0]))
        if step.oriented:
            out += self._state_events()
            out.append(_sample(message, reading, step.oriented[-1]))
        return out

    def _warnings(
        self, message: RawMessage, values: Mapping[int, object], *, restarted: bool, missing: int
    ) -> list[Decoded]:
        """Return warnings about missing measurements and saturation."""
        out: list[Decoded] = []
        if restarted:
            text = (
                f"{missing} measurements missing: orientation filter restarted, heading uncertain"
            )
            out.append(DeviceEvent("warning", text, {"missing": missing}))

        # The status word reports saturation, but a device need not send it. Otherwise saturation is
        # detected by repetition: because of noise, a high rate repeats exactly only at the end of
        # the gyroscope's range.
        before, rate = self._rate, cast("Vector | None", values.get(RATES[0]))
        self._rate = rate or (0.0, 0.0, 0.0)
        pairs = zip(self._rate, before, strict=True)
        clipped = any(now == then and abs(now) > FAST for now, then in pairs)
        clipped |= message.status is not None and bool(message.status & CLIPPING)
        if clipped and self._t_ns - self._clipped_ns >= _REPORT_NS:
            self._clipped_ns = self._t_ns
            text = "a measurement was out of range: heading is uncertain until the next static pose"
            out.append(DeviceEvent("warning", text, {"status": message.status}))
        return out

    def _state_events(self) -> list[Decoded]:
        """Return the filter's state if it is due."""
        out: list[Decoded] = []
        if not self._started and not self._made[1]:
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
            "magnetometer": self._made[1],
            "disturbed": state.disturbed,
            "settled": not self._filter.settling,
            "converging": state.converging,
            "period_ms": round(self._filter.period_ns * 1e-6, 6),
        }
        out.append(DeviceEvent("info", "orientation filter", {"orientation_filter": data}))
        return out


def _sample(
    message: RawMessage,
    reading: RawReading,
    oriented: FilterOutput,
) -> ImuSample:
    q = oriented.q_world_sensor
    arrival_ns, ticks, counter, status = message
    # The device sends the mean rate since the previous sample, not the present one.
    rate, force, field = None, reading.force, reading.magnetic
    return ImuSample(arrival_ns, q, q, ticks, counter, status, rate, force, field)


def _rotation_vector(q: tuple[float, float, float, float]) -> Vector:
    """Return the rotation vector 2 log(q), rad, of norm at most pi."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    length = sqrt(x * x + y * y + z * z)
    scale = 2.0 * atan2(length, w) / length if length > _TINY else 2.0
    return (scale * x, scale * y, scale * z)


def _scaled(vector: Vector, scale: float) -> Vector:
    return (vector[0] * scale, vector[1] * scale, vector[2] * scale)
