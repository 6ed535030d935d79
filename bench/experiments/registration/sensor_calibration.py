"""Error of orientations from raw readings, before and after the calibration of the sensor.

Twelve simulated sensors have different biases, scale errors, soft and hard iron. They are
calibrated by the guided steps of `jointfit calibrate sensor`, and then turned for half a minute.
The filter of the drivers computes the orientation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result
from bench.framework.material import Material
from jointfit_daemon.calibration.inertial_sensor import (
    DIRECTIONS,
    AccelerometerStep,
    GyroscopeStep,
    MagnetometerStep,
    SensorReading,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import ImuSample
from jointfit_daemon.sensor_calibration import SensorCalibrationSettings
from jointfit_drivers.gateway_orientation import (
    RawReading,
    RawSamples,
    RawStamp,
    SensorCorrection,
)
from tests.calibration.inertial_sensor.faulty_sensor import posed_rotation

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_daemon.arrays import Array

SENSORS = 12
RATE_HZ = 100
STEP_NS = 10_000_000
GRAVITY, FIELD = 9.81, 48.0
NOISE = (0.003, 0.03, 0.3)
"""Standard deviations of the noise of angular rate, rad/s, specific force, m/s², and field, uT."""
SIMULATED_SENSORS = Material(
    "12 simulated sensors with bias (0.6 deg/s and 0.3 m/s²), scale errors (2 %), hard-"
    "iron errors (25 uT) and soft-iron errors (8 % of 48 uT), all as standard deviations, "
    "and white noise",
    "orientations of the simulation, without acceleration",
)
POSES = DIRECTIONS[[0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 14, 15]]


@dataclass(frozen=True)
class SimulatedSensor:
    """Biases and error matrices of a sensor: reading = matrix · true value + bias.

    The matrices of accelerometer and magnetometer are symmetric.
    """

    biases: Array
    rate_matrix: Array
    force_matrix: Array
    field_matrix: Array

    @classmethod
    def draw(cls, rng: np.random.Generator) -> SimulatedSensor:
        """Return a sensor with random errors of low-cost parts."""
        biases = rng.normal(0.0, 1.0, (3, 3)) * np.array((0.01, 0.3, 25.0))[:, None]
        rate_matrix = _near_identity(rng, 0.02, 0.0) + rng.normal(0.0, 0.004, (3, 3))
        return cls(
            biases, rate_matrix, _near_identity(rng, 0.02, 0.004), _near_identity(rng, 0.08, 0.03)
        )

    def measure(
        self, up: Array, north: Array, rates: Array, rng: np.random.Generator
    ) -> list[SensorReading]:
        """Return readings; `up` and `north` are unit vectors in sensor axes."""
        true = (
            rates @ self.rate_matrix.T,
            GRAVITY * up @ self.force_matrix,
            FIELD * north @ self.field_matrix,
        )
        rows = np.concatenate(
            [
                values + bias + rng.normal(0.0, sd, values.shape)
                for values, bias, sd in zip(true, self.biases, NOISE, strict=True)
            ],
            axis=1,
        ).tolist()
        return [
            SensorReading(k * STEP_NS, (a, b, c), (d, e, f), (g, h, i))
            for k, (a, b, c, d, e, f, g, h, i) in enumerate(rows)
        ]


def calibrate(sensor: SimulatedSensor, rng: np.random.Generator) -> SensorCalibrationSettings:
    """Return the calibration table that the guided steps yield."""
    still = np.zeros((8 * RATE_HZ, 3))
    level = np.tile((0.0, 0.0, 1.0), (len(still), 1))
    rest, static, free = GyroscopeStep(), AccelerometerStep(), MagnetometerStep()
    for reading in sensor.measure(level, level, still, rng):
        rest.add(reading)
    for reading in _posed(sensor, rng):
        static.add(reading)
    for reading in _turned(sensor, rng):
        free.add(reading)

    accelerometer, magnetometer = static.finish(), free.finish()
    scale = static.finish_gyroscope_scale(accelerometer)
    return SensorCalibrationSettings.model_validate(
        {
            "date": "2026-11-23",
            "gyroscope_bias_deg_s": tuple(np.rad2deg(rest.finish().bias)),
            "gyroscope_matrix": tuple(map(tuple, scale.matrix)),
            "accelerometer_bias": tuple(accelerometer.bias),
            "accelerometer_matrix": tuple(map(tuple, accelerometer.matrix)),
            "magnetometer_bias": tuple(magnetometer.bias),
            "magnetometer_matrix": tuple(map(tuple, magnetometer.matrix)),
        }
    )


def _posed(sensor: SimulatedSensor, rng: np.random.Generator) -> list[SensorReading]:
    """Return readings of static poses of 2 s and of the turns between them."""
    q, rates = posed_rotation(POSES, rng, 2.0, RATE_HZ)
    up = rotation.rotate(rotation.conjugate(q), np.tile((0.0, 0.0, 1.0), (len(q), 1)))
    return sensor.measure(up, up, rates, rng)


def _turned(sensor: SimulatedSensor, rng: np.random.Generator) -> list[SensorReading]:
    """Return readings for the magnetometer step: 600 random directions of the field."""
    north = _unit(rng.normal(size=(600, 3)))
    return sensor.measure(north, north, np.zeros(north.shape), rng)


def turned_sensor(
    sensor: SimulatedSensor, rng: np.random.Generator
) -> tuple[Array, list[SensorReading]]:
    """Return orientations, shape (n, 4), and readings of half a minute of rotation by hand."""
    t_s = np.arange(30 * RATE_HZ) / RATE_HZ
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    q = rotation.exp(
        1.2 * np.column_stack([np.sin((0.5 + 0.2 * k) * t_s + phases[k]) for k in range(3)])
    )
    rates = rotation.log(rotation.multiply(rotation.conjugate(q[:-1]), q[1:])) * RATE_HZ
    up, north = (
        rotation.rotate(rotation.conjugate(q), np.tile(v, (len(q), 1)))
        for v in ((0.0, 0.0, 1.0), (0.0, 0.4, -np.sqrt(0.84)))
    )
    return q, sensor.measure(up, north, np.vstack((rates[:1], rates)), rng)


def orientation_error(
    q: Array, readings: list[SensorReading], calibration: SensorCalibrationSettings | None
) -> tuple[float, float]:
    """Return the RMS errors of orientation and inclination, deg, without the first 10 s."""
    correction = None if calibration is None else SensorCorrection(calibration)
    samples = RawSamples(RATE_HZ, magnetometer=True, correction=correction)
    found = [
        item
        for reading in readings
        for item in samples.take(RawStamp(reading.t_ns, reading.t_ns), RawReading(*reading))
        if isinstance(item, ImuSample) and item.arrival_ns >= 10 * 10**9
    ]
    estimated = np.array([item.q_world_sensor for item in found])
    true = q[[item.arrival_ns // STEP_NS for item in found]]
    one, other = (
        rotation.rotate(rotation.conjugate(each), np.tile((0.0, 0.0, 1.0), (len(each), 1)))
        for each in (estimated, true)
    )
    tilt = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1))
    return _rms_deg(rotation.angle_between(estimated, true)), _rms_deg(tilt)


def before_and_after(_: Path) -> list[Result]:
    """Measure orientation errors and gyroscope scale errors: median and largest of the sensors."""
    errors, scales = [], []
    for seed in range(SENSORS):
        rng = np.random.default_rng(seed)
        sensor = SimulatedSensor.draw(rng)
        calibration = calibrate(sensor, rng)
        q, readings = turned_sensor(sensor, rng)
        errors.append([orientation_error(q, readings, each) for each in (None, calibration)])
        corrected = np.array(calibration.gyroscope_matrix) @ sensor.rate_matrix
        factors = (np.diag(sensor.rate_matrix), np.diag(corrected))
        scales.append([100.0 * np.abs(each - 1.0).max() for each in factors])
    table = np.array(errors)  # axes: sensor, before/after, whole/tilt
    limits: Mapping[tuple[str, str], float] = {
        ("after", "orientation"): 0.4,
        ("after", "inclination"): 0.2,
    }
    by_quantity = [
        Result(
            f"{quantity} {when} calibration, {name}",
            float(statistic(table[:, row, column])),
            limits.get((when, quantity), float("inf")),
        )
        for column, quantity in enumerate(("orientation", "inclination"))
        for row, when in enumerate(("before", "after"))
        for name, statistic in _STATISTICS
    ]
    by_sensor = np.array(scales)
    return by_quantity + [
        Result(
            f"scale of the gyroscope {when} calibration, {name}",
            float(statistic(by_sensor[:, row])),
            0.3 if when == "after" else float("inf"),
            unit="%",
        )
        for row, when in enumerate(("before", "after"))
        for name, statistic in _STATISTICS
    ]


_STATISTICS = (("median", np.median), ("largest", np.max))


def _near_identity(rng: np.random.Generator, scale_sd: float, skew_sd: float) -> Array:
    skew = np.triu(rng.normal(0.0, skew_sd, (3, 3)), 1)
    return np.asarray(np.diag(1.0 + rng.normal(0.0, scale_sd, 3)) + skew + skew.T)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _rms_deg(angles: Array) -> float:
    return float(np.rad2deg(np.sqrt(np.mean(angles**2))))


EXPERIMENTS = (
    Experiment(
        "sensor-calibration-before-and-after",
        "Orientation from raw readings, before and after the calibration of the sensor",
        before_and_after,
        SIMULATED_SENSORS,
        packages=("vqf",),
        long=True,
    ),
)
