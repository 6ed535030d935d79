"""Orientations computed from readings that the calibration of the sensor corrects."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from pydantic import ValidationError

from jointfit_daemon.calibration.inertial_sensor import (
    DIRECTIONS,
    AccelerometerStep,
    GyroscopeStep,
    MagnetometerStep,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_daemon.sensor_calibration import (
    CalibratableSettings,
    SensorCalibrationSettings,
    exchanged_sensor,
)
from jointfit_drivers.gateway_orientation import (
    GatewaySettings,
    RawReading,
    RawSamples,
    RawStamp,
    SensorCorrection,
)
from jointfit_drivers.ximu3._raw_orientation import XImu3RawOrientation
from jointfit_protocols.ximu3 import DataKind, XImu3Data
from tests.calibration.inertial_sensor.faulty_sensor import RATE_HZ, STEP_NS, FaultySensor, poses

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

pytest.importorskip("vqf")
CALIBRATION = SensorCalibrationSettings(
    date="2026-11-23",
    serial="0123ABCD",
    gyroscope_bias_deg_s=(1.0, -2.0, 0.5),
    accelerometer_bias=(0.1, 0.2, -0.3),
    accelerometer_matrix=((1.01, 0.002, 0.0), (0.002, 0.99, 0.001), (0.0, 0.001, 1.02)),
    magnetometer_bias=(10.0, -5.0, 20.0),
    magnetometer_matrix=((1.1, 0.0, 0.0), (0.0, 0.9, 0.0), (0.0, 0.0, 1.0)),
)


def rows(matrix: Array) -> Any:
    return tuple(map(tuple, matrix.tolist()))


def calibrated(sensor: FaultySensor) -> SensorCalibrationSettings:
    """Return the table that a guided calibration of this sensor yields."""
    rest, static, free = GyroscopeStep(), AccelerometerStep(), MagnetometerStep()
    for reading in sensor.at_rest(8.0):
        rest.add(reading)
    for reading in sensor.posed(poses()):
        static.add(reading)
    for reading in sensor.turned(DIRECTIONS, count=600):
        free.add(reading)
    gyroscope, accelerometer, magnetometer = rest.finish(), static.finish(), free.finish()
    scale = static.finish_gyroscope_scale(accelerometer)
    return SensorCalibrationSettings(
        date="2026-11-23",
        gyroscope_bias_deg_s=tuple(np.rad2deg(gyroscope.bias)),
        gyroscope_matrix=rows(scale.matrix),
        accelerometer_bias=tuple(accelerometer.bias),
        accelerometer_matrix=rows(accelerometer.matrix),
        magnetometer_bias=tuple(magnetometer.bias),
        magnetometer_matrix=rows(magnetometer.matrix),
    )


def orientation_error(sensor: FaultySensor, calibration: SensorCalibrationSettings | None) -> float:
    """Return the RMS error of the orientation in slow rotation, from 10 s to 30 s, rad."""
    t_s = np.arange(30 * RATE_HZ) / RATE_HZ
    turns = 1.2 * np.column_stack([np.sin((0.5 + 0.2 * k) * t_s + k) for k in range(3)])
    q = rotation.exp(turns)
    rates = rotation.log(rotation.multiply(rotation.conjugate(q[:-1]), q[1:])) * RATE_HZ
    up, north = (
        rotation.rotate(rotation.conjugate(q), np.tile(v, (len(q), 1)))
        for v in ((0.0, 0.0, 1.0), (0.0, 0.4, -0.9165))
    )
    readings = sensor.readings(up, north, np.vstack((rates[:1], rates)), 5)
    correction = None if calibration is None else SensorCorrection(calibration)
    samples = RawSamples(RATE_HZ, magnetometer=True, correction=correction)
    out = []
    for reading in readings:
        found = samples.take(RawStamp(reading.t_ns, reading.t_ns), RawReading(*reading))
        out += [each for each in found if isinstance(each, ImuSample)]
    late = [each for each in out if each.arrival_ns >= 10 * 10**9]
    true = q[[each.arrival_ns // STEP_NS for each in late]]
    error = rotation.angle_between(np.array([each.q_world_sensor for each in late]), true)
    return float(np.sqrt(np.mean(error**2)))


def test_calibration_reduces_the_error_of_the_orientation() -> None:
    before, after = [], []
    for seed in range(6):
        sensor = FaultySensor.draw(seed)
        before.append(np.rad2deg(orientation_error(sensor, None)))
        after.append(np.rad2deg(orientation_error(sensor, calibrated(sensor))))
    assert np.median(after) < 0.1 * np.median(before)
    assert max(after) < 1.5


def one_reading(number: int = 0) -> RawReading:
    return RawReading(number * STEP_NS, (0.1, 0.2, 0.3), (1.0, 2.0, 9.0), (30.0, 10.0, -20.0))


def test_a_reading_is_corrected_by_bias_and_matrix() -> None:
    found = SensorCorrection(CALIBRATION).correct(one_reading(), field=True)
    np.testing.assert_allclose(found.rate, np.array((0.1, 0.2, 0.3)) - np.deg2rad((1, -2, 0.5)))
    matrix = np.array(CALIBRATION.accelerometer_matrix)
    np.testing.assert_allclose(found.force, matrix @ (0.9, 1.8, 9.3))
    assert found.magnetic is not None
    np.testing.assert_allclose(found.magnetic, (1.1 * 20.0, 0.9 * 15.0, -40.0))
    again = SensorCorrection(CALIBRATION).correct(one_reading(), field=False)
    assert again.magnetic == one_reading().magnetic


def test_a_calibration_without_errors_changes_no_sample() -> None:
    outputs = []
    for correction in (None, SensorCorrection(SensorCalibrationSettings(date="2026-11-23"))):
        samples = RawSamples(RATE_HZ, magnetometer=True, settle_s=0.0, correction=correction)
        outputs.append(
            [
                each
                for k in range(40)
                for each in samples.take(RawStamp(k, k), one_reading(k))
                if isinstance(each, ImuSample)
            ]
        )
    assert len(outputs[0]) == 40
    assert outputs[0] == outputs[1]


def settings(**more: Any) -> GatewaySettings:
    head = {"id": "S1", "segment": "shank", "driver": "xbus", "orientation": "gateway"}
    return GatewaySettings.model_validate(head | {"magnetometer": True} | more)


def test_settings_for_readings_return_each_reading_uncorrected() -> None:
    own = settings(sensor_calibration=CALIBRATION)
    assert isinstance(own, CalibratableSettings)
    samples = RawSamples.of(own.for_readings())
    (found,) = samples.take(RawStamp(5, 6), one_reading())
    assert isinstance(found, ImuSample)
    assert (found.rate, found.acceleration, found.magnetic) == one_reading()[1:]
    assert not own.readings_only


def test_health_contains_the_day_of_the_calibration() -> None:
    samples = RawSamples.of(settings(sensor_calibration=CALIBRATION, settle_s=0.0))
    events = [each for k in range(9) for each in samples.take(RawStamp(k, k), one_reading(k))]
    (state,) = [each.data for each in events if isinstance(each, DeviceEvent)]
    assert "'sensor_calibration': '2026-11-23'" in str(state["orientation_filter"])


def test_field_between_messages_is_rotated_after_its_offset_is_removed() -> None:
    own = settings(driver="ximu3", sensor_calibration=CALIBRATION, settle_s=0.0)
    device = XImu3RawOrientation(partial(RawSamples.of, own))
    device.measure_field(XImu3Data(DataKind.MAGNETIC, 0, (30.0, 10.0, -20.0)))
    out = []
    for k in range(6):
        values = (90.0 + 1.0, -2.0, 0.5, 0.0, 0.0, 1.0)
        out += device.samples(XImu3Data(DataKind.INERTIAL, 20_000 * k, values), k) or []
    last = [each for each in out if isinstance(each, ImuSample)][-1]
    # the corrected field, rotated about x by 90 degrees per second for 0.1 s, keeps its magnitude
    true = np.array((22.0, 13.5, -40.0))
    assert last.magnetic is not None
    assert np.linalg.norm(last.magnetic) == pytest.approx(np.linalg.norm(true), rel=1e-3)
    assert last.magnetic[0] == pytest.approx(22.0, rel=1e-2)


def test_another_serial_number_is_reported_with_the_remedy() -> None:
    own = settings(sensor_calibration=CALIBRATION)
    assert exchanged_sensor(own, "0123ABCD") is None
    assert exchanged_sensor(settings(), "77") is None
    text = exchanged_sensor(own, "77") or ""
    assert text.startswith("the sensor has serial number 77, but its sensor_calibration of 2026-")
    assert text.endswith(
        "belongs to 0123ABCD: connect that sensor, or repeat `jointfit calibrate sensor S1`"
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"magnetometer_bias": None}, "magnetometer_bias: is missing, and magnetometer_matrix is"),
        (
            {"accelerometer_matrix": ((1, 0, 0), (0, -1, 0), (0, 0, 1))},
            "row 2, column 2 is -1, expected 1 ± 0.9: repeat the calibration",
        ),
        ({"date": "yesterday"}, "pattern"),
    ],
)
def test_a_damaged_calibration_is_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text.replace("±", ".")):
        SensorCalibrationSettings.model_validate(CALIBRATION.model_dump() | change)


def test_a_calibration_needs_the_orientation_of_the_gateway() -> None:
    with pytest.raises(ValidationError, match='needs orientation = "gateway"'):
        settings(sensor_calibration=CALIBRATION, orientation="device", magnetometer=False)
