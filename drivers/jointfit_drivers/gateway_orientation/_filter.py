r"""Computation of the orientation from the raw measurements of one IMU, by the VQF filter.

VQF stands for "versatile quaternion-based filter". A relative error of the sample interval causes
the same relative error of every rotation. The interval is therefore computed from the device time
(`RawReading.t_ns`). The filter has a fixed step, which is the first interval T_s. If the device
time has a coarse resolution, the mean interval :math:`\bar T` differs from T_s. The filter
therefore receives the angular rate :math:`\omega` with a scale, so that every step rotates by the
true angle:

.. math:: \omega_\text{fed} = \omega\, \bar T / T_s

Up to three missing measurements are interpolated. After a longer gap the filter restarts with the
last gyroscope bias. Without a magnetometer, it also continues with the last heading, which is then
uncertain.

A filter that has just started takes its vertical from one accelerometer measurement. In fast
motion, the RMS error of the orientation is 18 degrees in the first second, 6 degrees in the second
and 4 degrees in the third. These values are from one IMU on a rigid board (bench experiment
``gateway-orientation-start-in-motion``). Orientations are therefore returned only when the filter
has detected rest or has run for `SETTLE_S`, or for ``settle_s`` if this time is shorter.

With a magnetometer, `StartEstimator` then estimates orientation and gyroscope bias from the
readings since the start, and continues with every reading. Orientations are returned when their
standard deviation is at most `SETTLED_SD`, or after ``settle_s``. The estimation ends as soon as
rest is detected or the standard deviation of the bias about every axis is at most `KNOWN_BIAS_SD`,
and after `CONVERGE_S` at the latest. The result of the estimation is then copied to VQF.

A magnetometer has a delay relative to the gyroscope. For the IMU of the BROAD data set, the delay
is 13 ms. This delay causes an error of 8 degrees at an angular rate of 579 degrees per second. The
filter estimates the delay from the readings since the start, and compensates it.

Invariant: the output depends only on the readings fed, so a replay yields identical orientations.
Only this module imports the optional package ``vqf``. The module is independent of the device.

Source: Laidig and Seel 2023, Information Fusion 91, 187-204, and their package ``vqf``.
"""

from __future__ import annotations

from collections import deque
from importlib import import_module
from importlib.util import find_spec
from math import atan2, ceil, cos, degrees, radians, remainder, sin, tau
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jointfit_daemon.kinematics.rotation import rotate
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.units import NS_PER_S
from jointfit_drivers.gateway_orientation._start_estimator import (
    GRAVITY,
    StartEstimator,
    StartReading,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.model import Quaternion, Vector

PACKAGE_MISSING = (
    "orientation on the gateway needs the package vqf: pip install 'jointfitd[vqf]', or set "
    'orientation = "device"'
)
MOST_MISSING = 3
"""Largest number of consecutive missing readings that are interpolated; more restart the filter."""
SETTLE_S = 3.0
"""Time constant of the low-pass filter of the accelerometer, s. The vertical is a mean over this
time."""
LONGEST_SETTLE_S = 8.0
"""Default of ``settle_s``, s. After this time orientations are returned, however uncertain they
are."""
SETTLED_SD = radians(5.0)
"""Largest standard deviation of the angle of the orientation of a settled filter, rad."""
CONVERGE_S = 60.0
"""Longest duration of the estimation at the start, s."""
KNOWN_BIAS_SD = radians(0.1)
"""Standard deviation of the bias, rad/s, that VQF reaches in motion (``biasSigmaMotion`` of
VQF)."""
FASTEST = 200.0
"""Largest plausible angular rate, rad/s; about 11 000 degrees per second."""
HARDEST = 5000.0
"""Largest plausible specific force, m/s^2; about 500 g."""
STRONGEST = 1e6
"""Largest plausible component of the magnetic field in any unit; equal to 1 T in microtesla."""
FIELD_RATIO = 2.0
"""Largest factor between the field strength and its median, in either direction, at which a reading
is used to estimate the delay of the magnetometer."""
RIDGE_RATE = 1.0
"""RMS angular rate, perpendicular to the field, below which the delay of the magnetometer is not
estimated, rad/s. At this rate, a delay of 20 ms changes the field by 2 %."""
MOST_DELAY_S = 0.05
"""Largest delay of the magnetometer, s."""
NO_FIELD = (0.0, 0.0, 0.0)
"""Field of a reading without magnetic field; the filter ignores it."""


class RawReading(NamedTuple):
    """Measurements of one IMU at one instant, in sensor axes."""

    t_ns: int
    """Device time without wraps, ns."""
    rate: Vector
    """Angular rate including bias, rad/s."""
    force: Vector
    """Specific force, m/s^2 (+9.81 upwards at rest)."""
    magnetic: Vector | None = None
    """Magnetic field in any unit; None if not measured."""


class FilterOutput(NamedTuple):
    """Output of the filter for one reading."""

    q_world_sensor: Quaternion
    """Orientation in an ENU world. With a magnetometer, y points to magnetic north. Otherwise the
    heading is arbitrary."""
    rate: Vector
    """Angular rate without bias, sensor axes, rad/s."""


class FilterStep(NamedTuple):
    """Result of one reading."""

    oriented: tuple[FilterOutput, ...]
    """Orientations: none while the filter settles, and later one per reading. Without a settling
    time, the second reading returns the orientations of the first and second reading."""
    missing: int = 0
    """Number of readings missing before this reading."""
    restarted: bool = False
    """Whether the filter restarted after a gap. The heading is then uncertain, and the inclination
    comes from the accelerometer."""


class FilterState(NamedTuple):
    """State of the filter for reports."""

    rest: bool
    """Whether the filter detects rest. At rest it estimates the gyroscope bias."""
    bias: Vector
    """Gyroscope bias, rad/s."""
    bias_sd: float
    """Upper bound of the bias standard deviation, rad/s."""
    disturbed: bool
    """Whether a magnetic disturbance was detected. The heading then comes from the gyroscope
    alone."""
    converging: bool
    """Whether the bias is not known yet, because the filter started in motion."""


def is_installed() -> bool:
    """Return whether the filter's package is installed, without importing it."""
    return find_spec("vqf") is not None


def is_plausible(reading: RawReading) -> bool:
    """Return whether a reading is finite and in range.

    After one NaN, all later outputs of the filter would be NaN.
    """
    if not all(-FASTEST < value < FASTEST for value in reading.rate):
        return False
    if not all(-HARDEST < value < HARDEST for value in reading.force):
        return False
    return reading.magnetic is None or all(-STRONGEST < v < STRONGEST for v in reading.magnetic)


class GatewayOrientation:
    """The orientation filter of one IMU.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz, which is used only until the second reading.
    magnetometer : bool
        Whether the heading comes from the magnetometer (9D). Otherwise the heading drifts (6D).
    settle_s : float
        Longest time without output after a start of the filter, s. Without magnetometer this time
        is at most `SETTLE_S`.
    """

    def __init__(
        self, rate_hz: float, *, magnetometer: bool, settle_s: float = LONGEST_SETTLE_S
    ) -> None:
        self._nominal_ns = 1e9 / rate_hz
        self._settle_ns = round(settle_s * NS_PER_S)
        self._started_ns: int | None = None  # None: the filter has settled
        self._magnetic = magnetometer
        self._filter: Any = None
        self._last: RawReading | None = None
        self._period_ns = 0.0  # step for which the filter was created
        self._delay_s = 0.0
        self._withheld: deque[StartReading] = deque()
        self._estimator: StartEstimator | None = None  # None: settling, or converged
        self._converging_ns = 0
        self._passed_ns = self._steps = 0
        self._turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._rate, self._force, self._field = np.empty(3), np.empty(3), np.empty(3)

    @property
    def period_ns(self) -> float:
        """Mean interval of the readings so far, ns; nominal before the second reading."""
        return self._passed_ns / self._steps if self._steps else self._nominal_ns

    @property
    def settling(self) -> bool:
        """Whether the filter has started but has not settled yet."""
        return self._started_ns is not None

    @property
    def state(self) -> FilterState | None:
        """State of the filter; None before its first reading."""
        if self._filter is None:
            return None
        bias, sd = self._filter.getBiasEstimate()
        x, y, z = bias.tolist()
        rest, disturbed = self._filter.getRestDetected(), self._filter.getMagDistDetected()
        return FilterState(
            bool(rest),
            (x, y, z),
            float(sd),
            self._magnetic and bool(disturbed),
            self._estimator is not None,
        )

    def take(self, reading: RawReading) -> FilterStep:
        """Update the filter with the next plausible reading; readings must be in order of time."""
        last, self._last = self._last, reading
        if last is None:
            return FilterStep(())

        passed_ns = reading.t_ns - last.t_ns
        steps = max(1, round(passed_ns / self.period_ns))

        followed = steps <= 1 + MOST_MISSING
        if followed:
            self._passed_ns += passed_ns
            self._steps += steps

        oriented: list[FilterOutput] = []
        if self._filter is None:
            self._start(self.period_ns, last.t_ns)
            oriented.append(self._update(last))

        if followed:
            for k in range(1, steps):
                self._update(_interpolate(last, reading, k / steps))
        else:
            # The filter gets a new inclination, but keeps the gyroscope bias.
            bias, sd = self._filter.getBiasEstimate()
            self._start(self._period_ns, reading.t_ns)
            self._filter.setBiasEstimate(bias, sd)
            oriented.clear()
        oriented.append(self._update(reading, follows=followed))

        # There is no output before the filter has settled.
        if self._started_ns is not None:
            self._settle(reading.t_ns, reading.t_ns - self._started_ns)
            oriented = [] if self.settling else [self._output(reading)]
        return FilterStep(tuple(oriented), steps - 1, restarted=not followed)

    def _start(self, period_ns: float, t_ns: int) -> None:
        self._period_ns = period_ns
        self._started_ns = t_ns if self._settle_ns else None
        # Only the most recent readings are stored, however long the filter settles.
        self._withheld = deque(maxlen=ceil(SETTLE_S * NS_PER_S / period_ns) + MOST_MISSING)
        self._estimator = None
        self._filter = import_module("vqf").VQF(period_ns / NS_PER_S)  # ``vqf`` is an extra
        # `StartEstimator` needs orientations that were integrated with a constant bias.
        self._filter.setMotionBiasEstEnabled(not (self._magnetic and self.settling))

    def _update(self, reading: RawReading, *, follows: bool = True) -> FilterOutput:
        """Update the filter with one reading, and return the output.

        After a gap, `follows` is false. Without magnetometer, the heading then continues unchanged.
        """
        # w_fed = w T_mean / T_s, so that every step rotates by the true angle.
        scale = self.period_ns / self._period_ns
        x, y, z = reading.rate
        fed = (x * scale, y * scale, z * scale)
        field = reading.magnetic if self._magnetic else None
        if field is not None and self._delay_s != 0.0:
            field = turned_field(field, reading.rate, self._delay_s)

        self._rate[:], self._force[:] = fed, reading.force
        if field is None:
            self._filter.update(self._rate, self._force)
        else:
            self._field[:] = field
            self._filter.update(self._rate, self._force, self._field)

        if self._magnetic and (self.settling or self._estimator is not None):
            w, i, j, k = self._filter.getQuat3D().tolist()
            part = StartReading((w, i, j, k), fed, reading.force, field or NO_FIELD)
            if self._estimator is None:
                self._withheld.append(part._replace(field=reading.magnetic or NO_FIELD))
            elif self._estimator.add(part):
                self._continue_start(self._estimator, reading.t_ns)
        return self._output(reading, follows=follows)

    def _settle(self, t_ns: int, waited_ns: int) -> None:
        """Estimate orientation and bias when it is time; record whether the filter has settled."""
        rest = self._filter.getRestDetected()
        if not rest and waited_ns < min(self._settle_ns, SETTLE_S * NS_PER_S):
            return
        if self._withheld:
            self._estimate_start(t_ns, rest=rest)

        estimator = self._estimator
        uncertain = estimator is not None and estimator.orientation_sd > SETTLED_SD
        if not uncertain or waited_ns >= self._settle_ns:
            self._started_ns = None

    def _estimate_start(self, t_ns: int, *, rest: bool) -> None:
        """Estimate orientation and bias from all readings since the start."""
        withheld = list(self._withheld)
        self._withheld.clear()
        if not any(any(part.field) for part in withheld):
            self._filter.setMotionBiasEstEnabled(True)
            return

        q, rates, fields = (np.array([part[kind] for part in withheld]) for kind in (0, 1, 3))
        found_s = _field_delay(q, rates, fields)
        self._delay_s = self._delay_s if found_s is None else found_s
        parts = [
            part._replace(field=turned_field(part.field, part.rate, self._delay_s))
            for part in withheld
        ]

        # At rest, the mean angular rate is the bias.
        assumed, bias_sd = self._filter.getBiasEstimate()
        bias = assumed
        if rest:
            bias = np.array(self._filter.state["restLastGyrLp"])
            bias_sd = radians(self._filter.params["biasSigmaRest"])
        self._estimator = StartEstimator(parts, self._period_ns / NS_PER_S, assumed, bias, bias_sd)
        self._converging_ns = t_ns
        self._continue_start(self._estimator, t_ns)

    def _continue_start(self, estimator: StartEstimator, t_ns: int) -> None:
        """Set the bias of VQF to the estimate; at the end, copy the complete estimate to VQF."""
        known = estimator.bias_sd <= KNOWN_BIAS_SD
        late = t_ns - self._converging_ns >= CONVERGE_S * NS_PER_S
        if not (known or late or self._filter.getRestDetected()):
            self._filter.setBiasEstimate(estimator.bias, estimator.bias_sd)
            return

        # The filter's accelerometer mean is set as if the estimated vertical had always been
        # measured.
        vqf, state = self._filter, self._filter.state
        q = estimator.q_world_gyro
        up = rotate(np.array([(q[0], -q[1], -q[2], -q[3])]), np.array([(0.0, 0.0, GRAVITY)]))[0]
        low_pass = [np.array(vqf.coeffs[name]) for name in ("accLpB", "accLpA")]
        initial = [vqf.filterInitialState(float(value), *low_pass) for value in up]
        state["lastAccLp"], state["accLpState"] = up.tolist(), np.concatenate(initial).tolist()

        # The internal frame of VQF keeps its heading, because the bias estimator stores means in
        # this frame.
        w, _, _, z = _heading_between(tuple(state["accQuat"]), q)
        state["accQuat"] = list(multiply_one((w, 0.0, 0.0, -z), q))
        state["delta"] = remainder(2.0 * atan2(z, w), tau)
        state["bias"] = estimator.bias.tolist()
        # The unit of this covariance in VQF is (0.01 deg/s)^2.
        state["biasP"] = (degrees(100.0) ** 2 * estimator.bias_covariance).ravel().tolist()
        vqf.state = state
        vqf.setMotionBiasEstEnabled(True)
        self._estimator = None

    def _output(self, reading: RawReading, *, follows: bool = True) -> FilterOutput:
        """Return the current orientation, and the angular rate of a reading without bias."""
        vqf = self._filter
        if self._estimator is not None:
            w, i, j, k = multiply_one(self._estimator.q_world_gyro, tuple(vqf.getQuat3D().tolist()))
        else:
            w, i, j, k = (vqf.getQuat9D() if self._magnetic else vqf.getQuat6D()).tolist()
        if not follows and not self._magnetic:
            self._turn = _heading_between((w, i, j, k), self._q)
        # The rotation about the vertical: (c, 0, 0, s) ⊗ q.
        c, s = self._turn[0], self._turn[3]
        self._q = (w, i, j, k)
        if s != 0.0:
            self._q = (c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w)

        x, y, z = reading.rate
        bx, by, bz = vqf.getBiasEstimate()[0].tolist()
        return FilterOutput(self._q, (x - bx, y - by, z - bz))


def _field_delay(
    q: NDArray[np.float64], rates: NDArray[np.float64], fields: NDArray[np.float64]
) -> float | None:
    r"""Return the delay of the magnetometer relative to the gyroscope, s; None if it is unknown.

    The field is constant in the world. If the measured field m has a delay d, the field rotated to
    the world is, to first order,

    .. math:: R m = m_w + d\, R (\omega \times m) ,

    where R rotates from the sensor to the world, m_w is the field in the world, and :math:`\omega`
    is the angular rate. A linear regression with a ridge term yields d. The ridge term corresponds
    to a disturbance of 2 % of the field and a delay of 20 ms. If the rotation is so slow that the
    ridge term dominates, the delay is unknown. Fields of implausible strength are excluded.

    Parameters
    ----------
    q : ndarray, shape (n, 4)
        Orientations q_world_sensor; the heading is arbitrary.
    rates, fields : ndarray, shape (n, 3)
        Angular rates, rad/s, and fields in sensor axes. Rows of zeros are missing fields.
    """
    strength = np.linalg.norm(fields, axis=1)
    known = strength > 0.0
    if not known.any():
        return None
    usual = float(np.median(strength[known]))
    known &= (strength < FIELD_RATIO * usual) & (strength > usual / FIELD_RATIO)
    q, rates, fields = q[known], rates[known], fields[known]

    world, moved = (rotate(q, v) for v in (fields, np.cross(rates, fields)))
    world, moved = world - world.mean(axis=0), moved - moved.mean(axis=0)
    ridge = RIDGE_RATE**2 * float(np.sum(fields**2))
    turned = float(np.sum(moved**2))
    if not turned > ridge:
        return None
    delay_s = float(np.sum(world * moved)) / (turned + ridge)
    return min(max(delay_s, 0.0), MOST_DELAY_S)


def turned_field(field: Vector, rate: Vector, delay_s: float) -> Vector:
    """Return the field that a sensor with this angular rate measures `delay_s` later."""
    x, y, z = field
    a, b, c = (-0.5 * delay_s * value for value in rate)
    scale = 2.0 / (1.0 + a * a + b * b + c * c)
    i, j, k = scale * (b * z - c * y), scale * (c * x - a * z), scale * (a * y - b * x)
    return (x + i + b * k - c * j, y + j + c * i - a * k, z + k + a * j - b * i)


def _heading_between(q_from: Quaternion, q_to: Quaternion) -> Quaternion:
    """Return the rotation about the vertical that brings `q_from` closest to `q_to`."""
    w, x, y, z = q_from
    a, b, c, d = q_to
    half = atan2(d * w - a * z - b * y + c * x, a * w + b * x + c * y + d * z)
    return (cos(half), 0.0, 0.0, sin(half))


def _interpolate(before: RawReading, after: RawReading, share: float) -> RawReading:
    """Return the linear interpolation between two readings at `share` of the interval."""

    def mix(a: Vector, b: Vector) -> Vector:
        x, y, z = (p + share * (q - p) for p, q in zip(a, b, strict=True))
        return x, y, z

    field = None
    if before.magnetic is not None and after.magnetic is not None:
        field = mix(before.magnetic, after.magnetic)
    t_ns = before.t_ns + round(share * (after.t_ns - before.t_ns))
    return RawReading(t_ns, mix(before.rate, after.rate), mix(before.force, after.force), field)
