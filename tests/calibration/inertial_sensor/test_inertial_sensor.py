"""Estimates of biases, scale factors and axes of simulated sensors with known errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f as f_distribution

from jointfit_daemon.calibration.inertial_sensor import (
    DIRECTIONS,
    AccelerometerStep,
    GyroscopeStep,
    MagnetometerStep,
    SensorCalibrationError,
    SensorReading,
    Turn,
    direction_names,
    fit_accelerometer,
    fit_gyroscope_scale,
    fit_magnetometer,
    nearest_direction,
)
from jointfit_daemon.calibration.inertial_sensor._turns import Rest
from jointfit_daemon.kinematics import rotation
from tests.calibration.inertial_sensor.faulty_sensor import (
    FIELD,
    GRAVITY,
    FaultySensor,
    draws,
    poses,
    symmetric,
    unit,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.inertial_sensor import GyroscopeScaleEstimate

AnyStep = TypeVar("AnyStep", GyroscopeStep, AccelerometerStep, MagnetometerStep)
SENSOR = FaultySensor.draw(1)
UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def fed(step: AnyStep, readings: Iterable[SensorReading]) -> AnyStep:
    for reading in readings:
        if step.is_complete:
            break
        step.add(reading)
    return step


def elements(matrix: Array) -> Array:
    return np.array([matrix[place] for place in UPPER])


def distance(error: Array, covariance: Array) -> float:
    """Return the squared Mahalanobis distance divided by the number of parameters.

    It has an F distribution if the covariance is correct.
    """
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


# --- gyroscope ------------------------------------------------------------------------------------


def test_gyroscope_bias_has_the_stated_uncertainty() -> None:
    errors, inside = [], []
    for seed, sensor in draws(80):
        found = fed(GyroscopeStep(), sensor.at_rest(8.0, seed)).finish()
        error = found.bias - sensor.gyroscope_bias
        errors.append(np.linalg.norm(error))
        # 3 `distance` is Hotelling's T squared, which has a scaled F distribution
        count, freedom = found.degrees_of_freedom, found.degrees_of_freedom - 2
        limit = f_distribution.ppf(0.95, 3, freedom) * count / freedom
        inside.append(distance(error, found.covariance) < limit)
    assert np.median(errors) < 3e-4
    assert max(errors) < 1e-3
    assert 0.9 <= np.mean(inside) <= 0.99


def test_rest_begins_again_after_a_movement() -> None:
    step = GyroscopeStep()
    moved = SENSOR.posed(poses()[:1], rest_s=5.0)
    for reading in moved + [r._replace(t_ns=r.t_ns + 10**10) for r in SENSOR.posed(poses()[1:2])]:
        step.add(reading)
    assert not step.is_complete
    with pytest.raises(SensorCalibrationError, match=r"moved during the rest: expected 6 s"):
        step.finish()


def test_slow_rotation_is_no_rest() -> None:
    # The sensor tilts by 2 degrees per second. Its rate is constant, but not its inclination.
    readings = SENSOR.at_rest(10.0)
    tilting = [
        reading._replace(
            force=(GRAVITY * np.sin(0.035 * k / 50), 0.0, GRAVITY * np.cos(0.035 * k / 50))
        )
        for k, reading in enumerate(readings)
    ]
    assert not fed(GyroscopeStep(), tilting).is_complete


def test_rate_at_rest_that_is_no_bias_is_refused() -> None:
    fast = [r._replace(rate=(0.0, 0.4, 0.0)) for r in SENSOR.at_rest(8.0)]
    with pytest.raises(SensorCalibrationError, match=r"22.9 deg/s, expected less than 15: check"):
        fed(GyroscopeStep(), fast).finish()


# --- accelerometer --------------------------------------------------------------------------------


def test_poses_correct_bias_scale_and_axes() -> None:
    before, after = [], []
    for seed, sensor in draws(20):
        found = fed(AccelerometerStep(), sensor.posed(poses(), seed)).finish()
        corrected = found.matrix @ sensor.accelerometer_matrix
        before.append(np.linalg.norm(sensor.accelerometer_bias))
        after.append(np.linalg.norm(found.bias - sensor.accelerometer_bias))
        assert found.residual < 0.01 < found.spread_before
        assert np.abs(corrected - np.eye(3)).max() < 0.003
    assert np.median(after) < 0.02 * np.median(before)
    assert max(after) < 0.02


@pytest.mark.parametrize(("count", "parameters"), [(10, 6), (16, 9)])
def test_accelerometer_covariance_covers_the_error(count: int, parameters: int) -> None:
    inside = []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        bias, scale = rng.normal(0.0, 0.3, 3), rng.normal(1.0, 0.02, 3)
        true = DIRECTIONS[:count] * GRAVITY
        forces = true * scale + bias + rng.normal(0.0, 0.005, (count, 3))
        found = fit_accelerometer(forces)
        assert len(found.covariance) == parameters
        error = np.concatenate(
            (found.bias - bias, elements(found.matrix) - elements(np.diag(1 / scale)))
        )
        limit = f_distribution.ppf(0.95, parameters, found.degrees_of_freedom)
        inside.append(distance(error[:parameters], found.covariance) < limit)
    assert 0.9 <= np.mean(inside) <= 0.99


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_exact_poses_give_exact_parameters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bias, matrix = rng.normal(0.0, 0.5, 3), symmetric(rng, 0.03, 0.02)
    directions = np.concatenate((DIRECTIONS[:6], unit(rng.normal(size=(12, 3)))))
    found = fit_accelerometer(GRAVITY * directions @ matrix + bias)
    np.testing.assert_allclose(found.bias, bias, atol=1e-7)
    np.testing.assert_allclose(found.matrix @ matrix, np.eye(3), atol=1e-8)


def test_missing_poses_are_named() -> None:
    step = fed(AccelerometerStep(), SENSOR.posed(DIRECTIONS[[0, 2, 4, 6]]))
    tilted = ("1 tilted between x and y", "2 tilted between x and z", "2 tilted between y and z")
    assert step.progress.missing == ("-x up", "-y up", "-z up", *tilted)
    assert step.progress.share == pytest.approx(1 / 3)
    with pytest.raises(SensorCalibrationError, match=r"4 static poses, expected at least 9.*-x up"):
        step.finish()


def test_the_same_pose_counts_once() -> None:
    step = fed(AccelerometerStep(), SENSOR.posed(DIRECTIONS[[0, 0, 0]]))
    assert step.progress.missing[:2] == ("-x up", "+y up")
    assert step.progress.share == pytest.approx(1 / 12)


def test_poses_without_tilt_between_two_axes_leave_the_axes_as_they_are() -> None:
    rng = np.random.default_rng(0)
    flat = DIRECTIONS[:14]  # no pose is tilted between y and z
    found = fit_accelerometer(GRAVITY * flat @ symmetric(rng, 0.02, 0.0) + rng.normal(0, 1e-3, 3))
    assert np.isnan(found.matrix_sd[1, 2])
    assert found.matrix[1, 2] == 0.0


def test_saturated_acceleration_is_refused() -> None:
    limit = 0.97 * GRAVITY / np.sqrt(2.0) - 0.6
    clipped = [
        r._replace(force=tuple(np.clip(r.force, -limit, limit)))
        for r in FaultySensor.draw(3).posed(DIRECTIONS)
    ]
    with pytest.raises(SensorCalibrationError, match=r"saturated. Set a larger range"):
        fed(AccelerometerStep(), clipped).finish()


def test_residual_that_is_too_large_is_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(SensorCalibrationError, match=r"differs from gravity by .* expected less"):
        fit_accelerometer(GRAVITY * DIRECTIONS * rng.normal(1.0, 0.03, (26, 1)))


def test_acceleration_in_another_unit_is_refused() -> None:
    with pytest.raises(SensorCalibrationError, match=r"scale error 920 %.*Check the unit"):
        fit_accelerometer(DIRECTIONS * 0.9614)


# --- scale of the gyroscope -----------------------------------------------------------------------


def scale_of(readings: Iterable[SensorReading]) -> GyroscopeScaleEstimate:
    step = AccelerometerStep()
    for reading in readings:
        step.add(reading)
    return step.finish_gyroscope_scale(step.finish())


def test_turns_between_poses_yield_scale_and_axes_of_the_gyroscope_with_their_uncertainty() -> None:
    errors, inside = [], []
    for seed, sensor in draws(20):
        jitter_ns = np.random.default_rng(seed).normal(0.0, 1e6, 6000).astype(int).tolist()
        readings = sensor.posed(poses(), seed)
        late = [r._replace(t_ns=r.t_ns + jitter_ns[k]) for k, r in enumerate(readings)]
        found = scale_of(late)
        assert found.turns == 11
        assert found.residual < 0.1 * found.spread_before
        error = (found.matrix - np.linalg.inv(sensor.gyroscope_matrix)).ravel()
        errors.append(np.abs(error).max())
        limit = f_distribution.ppf(0.95, 9, found.degrees_of_freedom)
        inside.append(distance(error, found.covariance) < limit)
    assert np.median(errors) < 0.001
    assert max(errors) < 0.004
    assert np.mean(inside) >= 0.8


def test_a_scale_about_an_axis_that_never_turns_while_level_is_not_determined() -> None:
    turns = []
    for angle in (0.5, 1.5, -1.0, 1.2, -1.2, 1.0, -1.5):  # all turns are about x
        q = rotation.exp(np.outer(np.linspace(0.0, 1.0, 50), (angle, 0.0, 0.0)))
        up = rotation.rotate(rotation.conjugate(q), np.tile((0.0, 0.0, 1.0), (50, 1)))
        rates = np.tile((1.03 * angle / 0.98, 0.0, 0.0), (50, 1))
        ends = [Rest(GRAVITY * each, np.zeros(3)) for each in (up[0], up[-1])]
        turns.append(Turn(np.linspace(0.0, 0.98, 50), rates, *ends))
    with pytest.raises(
        SensorCalibrationError, match=r"about [yz] .*once around about [yz] while this axis is"
    ):
        fit_gyroscope_scale(turns, lambda force: force)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda rate: np.clip(rate, -2.0, 2.0), r"11 saturated, expected at least 6"),
        (lambda rate: 2.0 * rate, r"check (the )?unit"),
    ],
)
def test_turns_that_contradict_gravity_yield_no_scale(change: Any, text: str) -> None:
    readings = SENSOR.posed(poses())
    wrong = [r._replace(rate=tuple(change(np.array(r.rate)).tolist())) for r in readings]
    with pytest.raises(SensorCalibrationError, match=text):
        scale_of(wrong)


def test_a_turn_with_a_pause_of_the_readings_is_left_out() -> None:
    readings = SENSOR.posed(poses())
    pause_ns = 10**9
    middle = next(k for k, r in enumerate(readings) if k > 200 and abs(r.rate[0]) > 1.0)
    late = [r._replace(t_ns=r.t_ns + pause_ns * (k > middle)) for k, r in enumerate(readings)]
    assert scale_of(late).turns == 10


# --- magnetometer ---------------------------------------------------------------------------------


def test_free_rotation_corrects_hard_and_soft_iron() -> None:
    before, after = [], []
    for seed, sensor in draws(20):
        found = fed(MagnetometerStep(), sensor.turned(DIRECTIONS, seed, 1500)).finish()
        before.append(np.linalg.norm(sensor.magnetometer_bias))
        after.append(np.linalg.norm(found.bias - sensor.magnetometer_bias))
        corrected = found.matrix @ sensor.magnetometer_matrix
        corrected /= np.linalg.det(corrected) ** (1.0 / 3.0)
        assert np.linalg.det(found.matrix) == pytest.approx(1.0)
        assert np.abs(corrected - np.eye(3)).max() < 0.01
        assert found.residual < 0.012
    assert np.median(after) < 0.01 * np.median(before)
    assert max(after) < 0.5


def test_magnetometer_covariance_covers_the_error() -> None:
    inside, magnitudes = [], []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        bias, matrix = rng.normal(0.0, 20.0, 3), symmetric(rng, 0.05, 0.02)
        true = FIELD * unit(rng.normal(size=(250, 3)))
        found = fit_magnetometer(true @ matrix + bias + rng.normal(0.0, 0.3, true.shape))
        expected = np.linalg.inv(matrix) * np.linalg.det(matrix) ** (1.0 / 3.0)
        error = np.concatenate((found.bias - bias, elements(found.matrix) - elements(expected)))[
            :-1
        ]  # the determinant is 1: eight elements are free
        limit = f_distribution.ppf(0.95, 8, found.degrees_of_freedom)
        inside.append(distance(error, found.covariance[:-1, :-1]) < limit)
        magnitudes.append(found.magnitude / (FIELD * np.linalg.det(matrix) ** (1.0 / 3.0)))
    assert 0.9 <= np.mean(inside) <= 0.99
    np.testing.assert_allclose(magnitudes, 1.0, atol=0.003)


def test_half_a_sphere_is_refused_with_the_missing_directions() -> None:
    upper = DIRECTIONS[DIRECTIONS[:, 2] > 0.3]
    step = fed(MagnetometerStep(), SENSOR.turned(upper, count=800))
    assert not step.is_complete
    with pytest.raises(SensorCalibrationError, match=r"of 26 directions.*missing in sensor axes: "):
        step.finish()


def test_disturbed_field_is_refused() -> None:
    fields = np.array([r.magnetic for r in SENSOR.turned(DIRECTIONS, count=800)])
    far = SENSOR.magnetometer_bias + (fields - SENSOR.magnetometer_bias) * np.linspace(
        0.8, 1.3, len(fields)
    ).reshape(-1, 1)
    with pytest.raises(
        SensorCalibrationError, match=r"the field is disturbed. Repeat at least 1 m"
    ):
        fit_magnetometer(far)


def test_saturated_field_is_refused() -> None:
    fields = np.array([r.magnetic for r in SENSOR.turned(DIRECTIONS, count=800)])
    fields[:, 0] += 60.0 - np.quantile(fields[:, 0], 0.8)
    with pytest.raises(SensorCalibrationError, match=r"are exactly 60: they are saturated"):
        fit_magnetometer(np.minimum(fields, (60.0, 999.0, 999.0)))


def test_readings_at_rest_carry_no_information() -> None:
    step = fed(MagnetometerStep(), SENSOR.at_rest(30.0))
    assert step.progress.share < 1.0
    with pytest.raises(SensorCalibrationError):
        step.finish()


def test_sensor_without_magnetometer_is_named() -> None:
    silent = [reading._replace(magnetic=None) for reading in SENSOR.at_rest(2.0)]
    with pytest.raises(SensorCalibrationError, match=r"no magnetometer readings arrived"):
        fed(MagnetometerStep(), silent).finish()


# --- directions -----------------------------------------------------------------------------------


def test_every_direction_is_nearest_to_itself_and_named_once() -> None:
    assert nearest_direction(3.0 * DIRECTIONS).tolist() == list(range(26))
    names = direction_names(range(26))
    assert len(set(names)) == 26
    assert names[0] == "+x"
    assert "+x -z" in names


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-100, 100)] * 10), min_size=0, max_size=60))
def test_a_step_accepts_any_readings(rows: list[tuple[Any, ...]]) -> None:
    for step in (GyroscopeStep(), AccelerometerStep(), MagnetometerStep()):
        for row in rows:
            step.add(SensorReading(round(row[9] * 1e9), row[:3], row[3:6], row[6:9]))
        assert 0.0 <= step.progress.share <= 1.0
        if not step.is_complete:
            with pytest.raises(SensorCalibrationError):
                step.finish()
