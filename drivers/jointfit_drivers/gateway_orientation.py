r"""Orientation on the gateway, from the raw readings of one IMU, by the VQF filter.

Law: pure and deterministic: a function of the readings fed, with no clock of its own, so that a
replay gives the same orientations bit by bit. This module alone imports ``vqf`` (an extra), and no
driver is named here: any driver whose device sends raw readings may use it.

A wrong sample time is as wrong a rotation: 1 % of one is 1 % of the other. So the time between
readings is the device's own (`Reading.t_ns`). The filter works with steps of the first interval
seen; where the mean interval turns out to be another (ticks too coarse for one interval), angular
rates are scaled so that every step turns by what really passed:

.. math:: \omega_\text{fed} = \omega\, \bar T / T_s

Up to three missing readings are interpolated. After a longer gap the filter begins anew: it keeps
the gyroscope's bias and, without a magnetometer, goes on at the heading it had, which is a guess.

A filter that has just begun takes one reading of the accelerometer for the vertical: in fast motion
20 degrees are wrong with that in the first second, 4 in the next two, then no more than ever
(``bench/fusion.py E-2``). So nothing is given out before it has settled: found rest, or worked for
`SETTLE_S`.

Source: Laidig and Seel 2023, Information Fusion 91, 187-204, and their package ``vqf``.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from math import atan2, cos, isfinite, sin
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector

PACKAGE_MISSING = (
    "orientation on the gateway needs the package vqf: pip install 'jointfitd[vqf]', or set "
    'orientation = "device"'
)
MOST_MISSING = 3
"""Readings in a row that are interpolated; more begin the filter anew."""
SETTLE_S = 3.0
"""Time constant of the filter's accelerometer: its vertical is a mean over as long."""
FASTEST = 200.0
"""No gyroscope reads more, rad/s: 11 000 degrees a second."""
HARDEST = 5000.0
"""No accelerometer reads more, m/s^2: 500 g."""
_NS = 1e9


class Reading(NamedTuple):
    """What one IMU felt at one instant, in its own axes."""

    t_ns: int
    """Device time, never wrapping, ns."""
    rate: Vector
    """Angular rate, rad/s; bias included."""
    force: Vector
    """Specific force, m/s^2: +9.81 upwards at rest."""
    magnetic: Vector | None = None
    """Magnetic field, any unit."""


class Oriented(NamedTuple):
    """What the filter makes of a reading."""

    q_world_sensor: Quaternion
    """ENU; y is magnetic north with a magnetometer, else anywhere."""
    rate: Vector
    """Angular rate without its bias, sensor axes, rad/s."""


class FilterStep(NamedTuple):
    """What one reading gave."""

    oriented: tuple[Oriented, ...]
    """None while the filter settles; then one a reading. Where it need not settle, none for the
    very first reading, which waits for the second; then two; then one each."""
    missing: int = 0
    """Readings that did not come in between."""
    began_anew: bool = False
    """The gap was too long: heading is a guess, inclination comes from the accelerometer."""


class FilterState(NamedTuple):
    """How the filter is doing."""

    rest: bool
    """The sensor is at rest: its bias is being measured."""
    bias: Vector
    """Of the gyroscope, rad/s."""
    bias_sd: float
    """Upper bound of its standard deviation, rad/s."""
    disturbed: bool
    """The magnetic field is not the earth's: heading comes from the gyroscope alone."""


def is_installed() -> bool:
    """Return whether the filter's package is there; nothing is imported."""
    return find_spec("vqf") is not None


def is_plausible(reading: Reading) -> bool:
    """Return whether a filter may see a reading: one NaN would never leave it again."""
    if not all(-FASTEST < value < FASTEST for value in reading.rate):
        return False
    if not all(-HARDEST < value < HARDEST for value in reading.force):
        return False
    return reading.magnetic is None or all(map(isfinite, reading.magnetic))


class GatewayOrientation:
    """The filter of one IMU.

    Parameters
    ----------
    rate_hz
        Nominal rate: only how many readings are missing before the second depends on it.
    magnetometer
        Whether heading comes from the magnetometer (9D) or drifts freely (6D).
    settle_s
        For how long at most nothing is given out after the filter has begun, s.
    """

    def __init__(self, rate_hz: float, *, magnetometer: bool, settle_s: float = SETTLE_S) -> None:
        self._nominal_ns = 1e9 / rate_hz
        self._settle_ns = round(settle_s * _NS)
        self._began_ns: int | None = None  # None: it has settled
        self._magnetic = magnetometer
        self._filter: Any = None
        self._last: Reading | None = None
        self._period_ns = 0.0  # what the filter was built for
        self._passed_ns = self._steps = 0
        self._turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._rate, self._force, self._field = np.empty(3), np.empty(3), np.empty(3)

    @property
    def period_ns(self) -> float:
        """Mean interval of the readings so far, ns; the nominal one before the second."""
        return self._passed_ns / self._steps if self._steps else self._nominal_ns

    @property
    def settling(self) -> bool:
        """Whether the filter has begun and is not to be believed yet."""
        return self._began_ns is not None

    @property
    def state(self) -> FilterState | None:
        """How the filter is doing; None before it began."""
        if self._filter is None:
            return None
        bias, sd = self._filter.getBiasEstimate()
        x, y, z = bias.tolist()
        rest, disturbed = self._filter.getRestDetected(), self._filter.getMagDistDetected()
        return FilterState(bool(rest), (x, y, z), float(sd), self._magnetic and bool(disturbed))

    def take(self, reading: Reading) -> FilterStep:
        """Take the next plausible reading, in order of time."""
        last, self._last = self._last, reading
        if last is None:
            return FilterStep(())
        passed_ns = reading.t_ns - last.t_ns
        steps = max(1, round(passed_ns / self.period_ns))
        followed = steps <= 1 + MOST_MISSING
        if followed:
            self._passed_ns += passed_ns
            self._steps += steps
        first: tuple[Oriented, ...] = ()
        if self._filter is None:
            self._begin(self.period_ns, last.t_ns)
            first = (self._update(last),)
        if not followed:
            self._begin_anew(reading.t_ns)
            return self._step((self._update(reading, follows=False),), reading, steps - 1, True)
        for k in range(1, steps):
            self._update(_between(last, reading, k / steps))
        return self._step((*first, self._update(reading)), reading, steps - 1)

    def _step(
        self,
        oriented: tuple[Oriented, ...],
        reading: Reading,
        missing: int,
        began_anew: bool = False,
    ) -> FilterStep:
        """Return what is given out: nothing before the filter has settled."""
        if self._began_ns is None:
            return FilterStep(oriented, missing, began_anew)
        waited_ns = reading.t_ns - self._began_ns
        if waited_ns < self._settle_ns and not self._filter.getRestDetected():
            return FilterStep((), missing, began_anew)
        self._began_ns = None
        return FilterStep(oriented[-1:], missing, began_anew)

    def _begin(self, period_ns: float, t_ns: int) -> None:
        self._period_ns = period_ns
        self._began_ns = t_ns if self._settle_ns else None
        self._filter = import_module("vqf").VQF(period_ns / _NS)  # an extra

    def _begin_anew(self, t_ns: int) -> None:
        """Forget the inclination; keep the bias, which is the sensor's own."""
        bias, sd = self._filter.getBiasEstimate()
        self._begin(self._period_ns, t_ns)
        self._filter.setBiasEstimate(bias, sd)

    def _update(self, reading: Reading, *, follows: bool = True) -> Oriented:
        """Feed one reading; where it does not follow the last one, go on at the same heading."""
        scale = self.period_ns / self._period_ns
        x, y, z = reading.rate
        self._rate[:] = (x * scale, y * scale, z * scale)
        self._force[:] = reading.force
        vqf = self._filter
        if self._magnetic and reading.magnetic is not None:
            self._field[:] = reading.magnetic
            vqf.update(self._rate, self._force, self._field)
        else:
            vqf.update(self._rate, self._force)
        w, i, j, k = (vqf.getQuat9D() if self._magnetic else vqf.getQuat6D()).tolist()
        if not follows and not self._magnetic:
            self._turn = _heading_between((w, i, j, k), self._q)
        c, s = self._turn[0], self._turn[3]
        self._q = (w, i, j, k) if s == 0.0 else _turned(c, s, (w, i, j, k))
        bx, by, bz = vqf.getBiasEstimate()[0].tolist()
        return Oriented(self._q, (x - bx, y - by, z - bz))


def _turned(c: float, s: float, q: Quaternion) -> Quaternion:
    """Return (c, 0, 0, s) times q: a turn about the vertical."""
    w, x, y, z = q
    return (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)


def _heading_between(q_from: Quaternion, q_to: Quaternion) -> Quaternion:
    """Return the turn about the vertical that brings `q_from` nearest to `q_to`."""
    w, x, y, z = q_from
    a, b, c, d = q_to
    half = atan2(d * w - a * z - b * y + c * x, a * w + b * x + c * y + d * z)
    return (cos(half), 0.0, 0.0, sin(half))


def _between(before: Reading, after: Reading, share: float) -> Reading:
    """Return the reading at `share` of the way, by straight lines."""

    def mix(a: Vector, b: Vector) -> Vector:
        return (
            a[0] + share * (b[0] - a[0]),
            a[1] + share * (b[1] - a[1]),
            a[2] + share * (b[2] - a[2]),
        )

    field = None
    if before.magnetic is not None and after.magnetic is not None:
        field = mix(before.magnetic, after.magnetic)
    t_ns = before.t_ns + round(share * (after.t_ns - before.t_ns))
    return Reading(t_ns, mix(before.rate, after.rate), mix(before.force, after.force), field)
