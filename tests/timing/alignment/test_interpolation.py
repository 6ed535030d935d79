"""Interpolation and extrapolation of orientations.

The results are exact at a constant rate. In fast motion, their errors are smaller than with slerp.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, degrees, pi, sin
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, RotationSpline

from jointfit_daemon.kinematics.rotation_scalar import (
    angle_between_one,
    between_one,
    interpolate_one,
    log_one,
    normalize_one,
)
from jointfit_daemon.timing.alignment._interpolation import (
    extrapolate_orientation,
    interpolate_orientation,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Quaternion, Vector

MS = 1_000_000
STEP = 10 * MS


@dataclass
class Sample:
    t_ns: int
    q: Quaternion
    rate: Vector | None = None
    turn: Vector | None = None


def negated(sample: Sample) -> Sample:
    w, x, y, z = sample.q
    return Sample(sample.t_ns, (-w, -x, -y, -z), sample.rate)


def quaternion(turn: Rotation) -> Quaternion:
    x, y, z, w = turn.as_quat().tolist()
    return (w, x, y, z)


def shaken() -> Callable[[float], tuple[Quaternion, Vector]]:
    """Return a function of a smooth motion about all axes, up to 20 rad/s, from SciPy's spline."""
    t = np.arange(0.0, 2.0, 0.02)
    turns = np.stack([np.sin(14 * t), 0.8 * np.sin(11 * t + 1), 0.6 * np.cos(17 * t)], axis=1)
    spline = RotationSpline(t, Rotation.from_rotvec(turns))

    def at(t_s: float) -> tuple[Quaternion, Vector]:
        x, y, z = spline(t_s, 1).tolist()
        return quaternion(spline(t_s)), (x, y, z)

    return at


MOTION = shaken()


def sample(t_ns: int, *, rate: bool = False) -> Sample:
    q, w = MOTION(0.5 + t_ns * 1e-9)
    return Sample(t_ns, q, w if rate else None)


def errors(found: Callable[[int, int], Quaternion]) -> float:
    """Return the RMS error of `found(first sample, offset)` in degrees, over half a second."""
    squares = []
    for k in range(50):
        for offset in range(MS, STEP, MS):
            truth, _ = MOTION(0.5 + (k * STEP + offset) * 1e-9)
            squares.append(degrees(angle_between_one(found(k * STEP, offset), truth)) ** 2)
    return float(np.sqrt(np.mean(squares)))


def test_the_spline_yields_body_rates_in_the_own_frame() -> None:
    """The convention of SciPy's rates is checked by a difference quotient."""
    q0, w = MOTION(0.7)
    q1, _ = MOTION(0.7 + 1e-6)
    turn = Rotation.from_quat([*q0[1:], q0[0]]).inv() * Rotation.from_quat([*q1[1:], q1[0]])
    assert turn.as_rotvec() / 1e-6 == pytest.approx(w, abs=1e-3)


def test_a_third_sample_reduces_the_error_in_fast_motion_and_rates_reduce_it_further() -> None:
    def slerp(t: int, x: int) -> Quaternion:
        return interpolate_one(sample(t).q, sample(t + STEP).q, x / STEP)

    def parabola(t: int, x: int) -> Quaternion:
        return interpolate_orientation(sample(t - STEP), sample(t), sample(t + STEP), t + x)

    def cubic(t: int, x: int) -> Quaternion:
        return interpolate_orientation(
            None, sample(t, rate=True), sample(t + STEP, rate=True), t + x
        )

    assert errors(parabola) < errors(slerp) / 4
    assert errors(cubic) < errors(parabola) / 4
    assert errors(cubic) < 0.01


def test_curvature_and_rates_both_reduce_the_error_of_an_extrapolation() -> None:
    def straight(t: int, x: int) -> Quaternion:
        return extrapolate_orientation(None, sample(t - STEP), sample(t), t + x)

    def bent(t: int, x: int) -> Quaternion:
        return extrapolate_orientation(sample(t - 2 * STEP), sample(t - STEP), sample(t), t + x)

    def measured(t: int, x: int) -> Quaternion:
        return extrapolate_orientation(
            None, sample(t - STEP, rate=True), sample(t, rate=True), t + x
        )

    assert errors(bent) < errors(straight) * 0.7
    assert errors(measured) < errors(straight) / 4


parts = st.floats(-1, 1)
quaternions = st.tuples(parts, parts, parts, parts).filter(
    lambda q: sum(part * part for part in q) > 0.01
)
rates = st.none() | st.tuples(*[st.floats(-30, 30)] * 3)
drawn = st.builds(Sample, st.just(0), quaternions.map(normalize_one), rates)


@given(drawn, drawn, drawn, st.integers(1, 40), st.integers(1, 40))
def test_samples_are_reproduced_for_any_quaternion_sign(
    before: Sample, a: Sample, b: Sample, gap: int, step: int
) -> None:
    before.t_ns, b.t_ns = -gap * MS, step * MS
    for left in (None, before, negated(before)):
        for right in (b, negated(b)):
            assert angle_between_one(interpolate_orientation(left, a, right, a.t_ns), a.q) < 1e-6
            assert angle_between_one(interpolate_orientation(left, a, right, b.t_ns), b.q) < 1e-6
    assert angle_between_one(extrapolate_orientation(None, before, a, a.t_ns), a.q) < 1e-6
    assert angle_between_one(extrapolate_orientation(b, before, a, a.t_ns), a.q) < 1e-6


@given(st.floats(-20, 20), st.integers(0, 25 * MS), st.booleans())
def test_a_constant_rate_is_reproduced_exactly(speed: float, x: int, known: bool) -> None:
    def at(t: int) -> Sample:
        half = speed * t * 1e-9 / 2
        rate = (speed, 0.0, 0.0) if known else None
        return Sample(t, (cos(half), sin(half), 0.0, 0.0), rate)

    past, now, soon = at(-STEP), at(0), at(25 * MS)
    assert angle_between_one(interpolate_orientation(past, now, soon, x), at(x).q) < 1e-6
    assert (
        angle_between_one(extrapolate_orientation(at(-STEP - 7 * MS), past, now, x), at(x).q) < 1e-6
    )


def test_rates_that_contradict_the_orientations_are_not_used() -> None:
    """Rates in degrees, about other axes or with another sign are not used."""
    a, b, before = sample(0), sample(STEP), sample(-STEP)
    plain, beyond_plain = (
        interpolate_orientation(before, a, b, 4 * MS),
        extrapolate_orientation(None, before, a, 4 * MS),
    )
    _, w = MOTION(0.5)
    for wrong in ((w[1], w[2], w[0]), (-w[0], -w[1], -w[2]), tuple(180 / pi * c for c in w)):
        for s in (a, b, before):
            s.rate = (wrong[0], wrong[1], wrong[2])
        assert interpolate_orientation(before, a, b, 4 * MS) == plain
        assert extrapolate_orientation(None, before, a, 4 * MS) == beyond_plain


def test_curvature_is_extrapolated_for_one_interval_only() -> None:
    """A parabola would overshoot after two periods, so the curvature applies to one period only."""
    earlier, before, a = (Sample(k * STEP, turned(x)) for k, x in ((-2, 0.0), (-1, 0.1), (0, 0.3)))
    assert (
        angle_between_one(extrapolate_orientation(earlier, before, a, STEP), turned(0.3 + 0.25))
        < 1e-9
    )
    assert (
        angle_between_one(
            extrapolate_orientation(earlier, before, a, 2 * STEP), turned(0.3 + 0.525)
        )
        < 1e-9
    )


def turned(angle: float) -> Quaternion:
    return (cos(angle / 2), 0.0, sin(angle / 2), 0.0)


@pytest.mark.experiment
def test_mean_rates_are_worse_than_no_rates() -> None:
    """A driver must therefore not send mean rates in ``ImuSample.rate``."""

    def mean(number: int) -> Sample:
        q, before = MOTION(0.5 + number * STEP * 1e-9)[0], MOTION(0.5 + (number - 1) * STEP * 1e-9)
        x, y, z = log_one(between_one(before[0], q))
        return Sample(number * STEP, q, (x / STEP * 1e9, y / STEP * 1e9, z / STEP * 1e9))

    def by(make: Callable[[int], Sample]) -> float:
        return errors(
            lambda t, x: interpolate_orientation(
                make(t // STEP - 1), make(t // STEP), make(t // STEP + 1), t + x
            )
        )

    assert by(mean) > 2.0 * by(lambda number: sample(number * STEP))
    assert by(lambda number: sample(number * STEP, rate=True)) < 0.2 * by(mean)
