"""The orientation filter of the gateway, for an IMU that starts in motion.

The tests limit the errors of the orientation and of the gyroscope bias. They compare the error of
the bias with the standard deviation that the filter states.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.kinematics import rotation
from jointfit_drivers.gateway_orientation import GatewayOrientation, RawReading

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

pytest.importorskip("vqf")
RATE_HZ = 100
FINE = 10
"""Number of simulation steps per reading."""
SEEDS = range(6)


@dataclass(frozen=True)
class MovingSensor:
    """Readings of a simulated sensor, its true orientation, and its true gyroscope bias, rad/s."""

    readings: list[RawReading]
    q: Array
    bias: Array


@dataclass(frozen=True)
class Run:
    """Errors of the filter, and its standard deviation of the bias; NaN while it has no output."""

    error_deg: Array
    bias_error: Array
    bias_sd: Array
    converging: list[bool]


@cache
def sensor(
    seed: int, *, speed: float = 0.3, rest_s: float = 0.0, seconds: float = 14.0
) -> MovingSensor:
    """Simulate a sensor that rotates by about 50 degrees and moves, and then rests for `rest_s`."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(round(seconds * RATE_HZ) * FINE) / (RATE_HZ * FINE)
    moving = 1.0 / (1.0 + np.exp((t_s - (seconds - rest_s)) / 0.1)) if rest_s else np.ones(len(t_s))

    def wandering(amplitude: float) -> Array:
        hz, phase = rng.uniform(0.1, 0.8, (5, 3)), rng.uniform(0.0, 2.0 * np.pi, (5, 3))
        waves = np.sin(2.0 * np.pi * hz[:, None] * t_s[None, :, None] + phase[:, None])
        return np.asarray(amplitude * waves.mean(axis=0) * np.sqrt(2.0 * 5.0) * moving[:, None])

    # orientation, and position with the given RMS speed
    start = rotation.normalize(rng.normal(size=4))
    turning = rotation.multiply(rotation.exp(wandering(0.5)), rotation.exp(wandering(0.5)))
    q = rotation.multiply(turning, start)
    velocity = wandering(speed)
    acceleration = np.gradient(velocity, t_s, axis=0)

    turned = rotation.log(rotation.multiply(rotation.conjugate(q[:-1]), q[1:])) * RATE_HZ * FINE
    rate = np.vstack([turned, turned[-1:]])
    force = rotation.rotate(rotation.conjugate(q), acceleration + np.array((0.0, 0.0, 9.81)))
    world = np.tile((0.0, 17.0, -42.0), (len(t_s), 1))
    field = rotation.rotate(rotation.conjugate(q), world)

    # sensor: bias, scale and hard-iron errors, noise
    bias = np.deg2rad(rng.normal(0.0, 0.4, 3))
    rates, forces = (v.reshape(-1, FINE, 3).mean(axis=1) for v in (rate, force))
    count = len(rates)
    rates = rates * (1.0 + rng.normal(0.0, 0.002, 3)) + bias + rng.normal(0.0, 0.002, (count, 3))
    forces = forces + rng.normal(0.0, 0.03, (count, 3))
    soft = np.eye(3) + rng.normal(0.0, 0.01, (3, 3))
    fields = (
        field[FINE - 1 :: FINE] @ soft + rng.normal(0.0, 0.4, 3) + rng.normal(0.0, 0.3, (count, 3))
    )
    rows = zip(rates.tolist(), forces.tolist(), fields.tolist(), strict=True)
    readings = [RawReading(k * 10_000_000, *map(tuple, row)) for k, row in enumerate(rows)]
    return MovingSensor(readings, q[FINE - 1 :: FINE], bias)


def run(moving: MovingSensor, **more: float) -> Run:
    filter_ = GatewayOrientation(RATE_HZ, magnetometer=True, **more)
    q = np.full(moving.q.shape, np.nan)
    bias_error, bias_sd = np.full((2, len(q)), np.nan)
    converging = []
    for k, reading in enumerate(moving.readings):
        step = filter_.take(reading)
        if step.oriented:
            q[k] = step.oriented[-1].q_world_sensor
        if (state := filter_.state) is not None:
            bias_error[k] = np.linalg.norm(np.array(state.bias) - moving.bias)
            bias_sd[k] = state.bias_sd
        converging.append(state is not None and state.converging)
    error = np.rad2deg(rotation.angle_between(q, moving.q))
    return Run(error, bias_error, bias_sd, converging)


@cache
def run_of(seed: int) -> Run:
    return run(sensor(seed))


def first_output(found: Run) -> int:
    return int(np.flatnonzero(np.isfinite(found.error_deg))[0])


def test_bias_is_estimated_in_motion_better_than_by_the_filter_alone() -> None:
    left = np.median([run_of(seed).bias_error[-1] for seed in SEEDS])
    alone = np.median([run(sensor(seed), settle_s=0.0).bias_error[-1] for seed in SEEDS])
    assert left < 0.6 * np.median([np.linalg.norm(sensor(seed).bias) for seed in SEEDS])
    assert left < 0.75 * alone


def test_orientation_is_right_in_the_first_second_and_later() -> None:
    for seed in SEEDS:
        error = run_of(seed).error_deg
        begin = first_output(run_of(seed))
        assert begin < 500
        assert np.sqrt(np.mean(error[begin : begin + RATE_HZ] ** 2)) < 6.0
        assert np.sqrt(np.mean(error[1000:1100] ** 2)) < 4.0


def test_stated_deviation_of_the_bias_covers_its_error() -> None:
    for seed in SEEDS:
        found = run_of(seed)
        assert found.converging[-1]
        assert found.bias_error[-1] < 3.0 * found.bias_sd[-1]
        assert found.bias_sd[-1] < 0.8 * found.bias_sd[400]


def test_sensor_that_moves_fast_is_silent_for_longer() -> None:
    slow, fast = (first_output(run(sensor(1, speed=speed, seconds=10.0))) for speed in (0.2, 2.5))
    assert slow < 350
    assert slow + 100 < fast <= 801


def test_longest_silence_is_configured() -> None:
    assert first_output(run(sensor(1, speed=2.5, seconds=10.0), settle_s=2.0)) == 200


def test_filter_takes_over_at_rest_without_a_jump() -> None:
    resting = sensor(2, rest_s=5.0)
    found = run(resting)
    end = found.converging.index(False, first_output(found))
    assert 900 < end < 1250
    before, after = found.error_deg[end - 1 : end + 1]
    assert abs(after - before) < 0.2
    assert found.error_deg[-1] < 4.0
    assert found.bias_error[-1] < np.deg2rad(0.1)


def test_disturbed_fields_do_not_turn_the_start() -> None:
    """For half a second, the field has three times the usual strength and another direction."""
    clean = sensor(3)
    readings = [
        reading._replace(magnetic=(90.0, 90.0, 10.0)) if 150 <= k < 200 else reading
        for k, reading in enumerate(clean.readings)
    ]
    found = run(MovingSensor(readings, clean.q, clean.bias))
    assert np.sqrt(np.mean(found.error_deg[1000:1100] ** 2)) < 4.0


def test_sensor_without_fields_settles_like_one_without_magnetometer() -> None:
    readings = [reading._replace(magnetic=None) for reading in sensor(4).readings]
    found = run(MovingSensor(readings, sensor(4).q, sensor(4).bias))
    assert first_output(found) == 300
    assert not any(found.converging)
