r"""Interpolation and short extrapolation of the orientations of one stream.

Quaternions are tuples of floats; a call takes a few microseconds. The requested instant is between
two samples or after the last sample. Sample *a* is the newest sample at or before this instant. All
computations use the tangent space of *a*, :math:`r(t) = \log(q_a^* q(t))`, in which the other
samples are vectors. Angular rates are rates of the body in body coordinates:
:math:`\dot q = q \otimes (0, \omega/2)`.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.kinematics.rotation_scalar import difference_one, perturb_one
from jointfit_daemon.units import S_PER_NS

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector

CURVATURE_SHARE = 0.5
"""Fraction of the measured curvature that an extrapolation uses (docs/timing.md)."""
_CONTRADICTS = 0.25
"""Largest accepted relative difference between a rotation and the integral of the measured rates.
"""
_CONTRADICTS_RAD = 0.02
"""Absolute difference that is accepted in addition to the relative difference, rad."""


class OrientationSample(Protocol):
    """Sample of a stream, as used by this module."""

    t_ns: int
    q: Quaternion
    rate: Vector | None
    """Angular rate in the sensor's own frame at ``t_ns``, rad/s; None if not measured."""
    turn: Vector | None
    """Rotation vector from the previous sample to this sample, rad. The value is cached. It is None
    until it is computed, and None again after a sample was inserted between the two samples.
    """


def interpolate_orientation(
    before: OrientationSample | None, a: OrientationSample, b: OrientationSample, t_ns: int
) -> Quaternion:
    r"""Return the orientation at `t_ns`, between the neighbors `a` and `b`.

    If both neighbors have rates, the result is a cubic Hermite interpolation in the tangent space
    of `a`. Without rates, but with a sample `before`, the result is the parabola through the three
    samples,

    .. math:: r(x) = r_b \frac{x (x + h_0)}{h_1 (h_0 + h_1)}
              + r_0 \frac{x (x - h_1)}{h_0 (h_0 + h_1)}

    where x is the time since `a`, :math:`h_0, h_1` are the intervals before and after `a`, and
    :math:`r_0, r_b` are the vectors of `before` and `b` in the tangent space of `a`. Without
    `before` the result is a spherical linear interpolation (slerp). The error of the parabola is of
    third order in the interval, and the error of slerp is of second order.

    Parameters
    ----------
    before, a, b : OrientationSample
        Successive samples in order of time; `before` may be None. Quaternions may have either sign.
    t_ns : int
        Instant in ``[a.t_ns, b.t_ns]``.
    """
    x, h = (t_ns - a.t_ns) * S_PER_NS, (b.t_ns - a.t_ns) * S_PER_NS
    turn = _turn_to(b, a)
    if a.rate is not None and b.rate is not None and _agree(a.rate, b.rate, turn, h):
        r = _hermite(a.rate, b.rate, turn, x, h)
    elif before is not None:
        h0 = (a.t_ns - before.t_ns) * S_PER_NS
        m, n = x * (x + h0) / (h * (h0 + h)), x * (h - x) / (h0 * (h0 + h))
        r = _combine(m, turn, n, _turn_to(a, before))  # `before` is at the negative of this vector
    else:
        share = x / h
        r = (share * turn[0], share * turn[1], share * turn[2])
    return perturb_one(a.q, r)


def extrapolate_orientation(
    earlier: OrientationSample | None,
    before: OrientationSample,
    a: OrientationSample,
    t_ns: int,
    bend: float = CURVATURE_SHARE,
) -> Quaternion:
    r"""Return the orientation at `t_ns`, after the last sample `a`.

    The motion continues at the last angular rate, which is measured or computed from the last
    interval. A fraction of the angular acceleration continues for the duration of this interval:

    .. math:: r(x) = v x + \beta\, d\, (x_c (x_c + h_0) + (2 x_c + h_0)(x - x_c)),
              \quad x_c = \min(x, h_0)

    where *x* is the time since `a`, *v* the rate of the last interval, :math:`h_0` the length of
    this interval, *d* the second divided difference (half the angular acceleration), and
    :math:`\beta` = 1/2. A larger :math:`\beta` follows faster motion but amplifies noise
    (docs/timing.md). With measured rates, the whole angular acceleration continues.

    Parameters
    ----------
    earlier, before, a : OrientationSample
        The last three samples in order of time; `earlier` may be None.
    t_ns : int
        Instant at or after ``a.t_ns``.
    bend : float
        The factor beta, used if rates are not measured.
    """
    x, h0 = (t_ns - a.t_ns) * S_PER_NS, (a.t_ns - before.t_ns) * S_PER_NS
    x_c = min(x, h0)
    turn = _turn_to(a, before)
    if a.rate is not None and before.rate is not None and _agree(before.rate, a.rate, turn, h0):
        ahead = x_c * (x - 0.5 * x_c) / h0
        r = _combine(x + ahead, a.rate, -ahead, before.rate)
    else:
        r = _combine(x / h0, turn, 0.0, turn)
        if earlier is not None:
            h1 = (before.t_ns - earlier.t_ns) * S_PER_NS
            first = difference_one(a.q, earlier.q)
            # In the tangent space of `a`, `earlier` is at `first`, `before` at -turn, and `a` at 0.
            weight = bend * (x_c * (x_c + h0) + (2.0 * x_c + h0) * (x - x_c)) / (h0 + h1)
            bent = _combine(weight * (1.0 / h0 + 1.0 / h1), turn, weight / h1, first)
            r = (r[0] + bent[0], r[1] + bent[1], r[2] + bent[2])
    return perturb_one(a.q, r)


def _turn_to(sample: OrientationSample, before: OrientationSample) -> Vector:
    """Return the rotation vector from `before` to `sample`, and store it in `sample`."""
    if sample.turn is None:
        sample.turn = difference_one(before.q, sample.q)
    return sample.turn


def _combine(m: float, u: Vector, n: float, v: Vector) -> Vector:
    return (m * u[0] + n * v[0], m * u[1] + n * v[1], m * u[2] + n * v[2])


def _cross(u: Vector, v: Vector) -> Vector:
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


def _agree(start: Vector, end: Vector, turn: Vector, h: float) -> bool:
    """Return whether the rates at both ends agree with the rotation between them.

    Rates with wrong axes or units do not agree.
    """
    miss = size = 0.0
    for i in range(3):
        miss += (0.5 * h * (start[i] + end[i]) - turn[i]) ** 2
        size += turn[i] ** 2
    return sqrt(miss) <= _CONTRADICTS_RAD + _CONTRADICTS * sqrt(size)


def _hermite(start: Vector, end: Vector, turn: Vector, x: float, h: float) -> Vector:
    """Return the value, rad, at `x` s of the cubic that goes from 0 to `turn` rad in `h` s.

    `start` and `end` are the body rates at both ends, rad/s.

    The tangent at the end is the rate `end` multiplied by the inverse right Jacobian of `turn`,
    ``w + r × w / 2 + r × (r × w) / 12`` with w = `end` and r = `turn`, accurate to third order.
    """
    across = _cross(turn, end)
    twice = _cross(turn, across)
    arrive = tuple(end[i] + 0.5 * across[i] + twice[i] / 12.0 for i in range(3))
    s = x / h
    m0, m1, n1 = h * s * (1.0 - s) ** 2, h * s * s * (s - 1.0), s * s * (3.0 - 2.0 * s)
    return (
        m0 * start[0] + m1 * arrive[0] + n1 * turn[0],
        m0 * start[1] + m1 * arrive[1] + n1 * turn[1],
        m0 * start[2] + m1 * arrive[2] + n1 * turn[2],
    )
