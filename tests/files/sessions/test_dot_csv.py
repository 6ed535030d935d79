"""CSV files of Movella DOT sensors: times, ids, units, orientations and increments in all modes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.files.sessions import read_session
from jointfit_daemon.files.text import MalformedFileError

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.session_data import SensorSeries, SessionData

HEADER = """DeviceTag:,{tag}
FirmwareVersion:,3.0.0
AppVersion:,2023.6.0
SyncStatus:,{sync}
OutputRate:,60Hz
FilterProfile:,General
Measurement Mode:,Sensor fusion Mode - Extended
StartTime: ,2025-07-11_20:06:00_086 WEST
© Movella Technologies B. V. 2005-2025

PacketCounter,SampleTimeFine,"""
PERIOD_US = 16_667
ROWS = 5


def written(
    path: Path,
    columns: str,
    rows: np.ndarray,
    *,
    first: int = 2_268_972_329,
    tag: str = "Thigh",
    sync: str = "Synced",
) -> Path:
    lines = [
        ",".join([str(n + 1), str((first + PERIOD_US * n) % 2**32), *map(repr, map(float, row))])
        for n, row in enumerate(rows)
    ]
    path.write_text(HEADER.format(tag=tag, sync=sync) + columns + "\n" + "\n".join(lines) + ",\n")
    return path


def sensor_of(session: SessionData) -> SensorSeries:
    (sensor,) = session.sensors
    return sensor


def test_quaternions_have_sensor_time_and_tag(tmp_path: Path) -> None:
    q = Rotation.random(ROWS, rng=np.random.default_rng(3)).as_quat(scalar_first=True)
    rows = np.column_stack([q, np.zeros((ROWS, 3)), np.zeros(ROWS)])
    columns = "Quat_W,Quat_X,Quat_Y,Quat_Z,FreeAcc_X,FreeAcc_Y,FreeAcc_Z,Status"
    sensor = sensor_of(read_session(written(tmp_path / "a.csv", columns, rows)))
    assert sensor.id == "Thigh"
    np.testing.assert_allclose(sensor.orientation, q, atol=1e-12)
    np.testing.assert_allclose(sensor.t_s, 1e-6 * PERIOD_US * np.arange(ROWS))
    assert sensor.acceleration is None  # FreeAcc is no specific force


def test_euler_angles_are_roll_pitch_and_yaw_in_degrees(tmp_path: Path) -> None:
    angles = np.random.default_rng(4).uniform(-80, 80, (ROWS, 3))
    path = written(tmp_path / "a.csv", "Euler_X,Euler_Y,Euler_Z,Status",
                   np.column_stack([angles, np.zeros(ROWS)]))  # fmt: skip
    expected = Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True)
    q = sensor_of(read_session(path)).orientation
    found = Rotation.from_quat(q, scalar_first=True)
    assert (found.inv() * expected).magnitude().max() < 1e-9


def test_rates_and_increments_have_si_units(tmp_path: Path) -> None:
    rate = np.random.default_rng(5).normal(0.0, 2.0, (ROWS, 3))
    force = np.random.default_rng(6).normal(0.0, 5.0, (ROWS, 3))
    rates = written(tmp_path / "rates.csv", "Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z",
                    np.column_stack([force, np.rad2deg(rate)]))  # fmt: skip
    dq = Rotation.from_rotvec(rate / 60.0).as_quat(scalar_first=True)
    steps = written(tmp_path / "steps.csv", "dq_W,dq_X,dq_Y,dq_Z,dv[1],dv[2],dv[3]",
                    np.column_stack([dq, force / 60.0]))  # fmt: skip
    for path in (rates, steps):
        sensor = sensor_of(read_session(path))
        assert sensor.angular_velocity is not None
        assert sensor.acceleration is not None
        np.testing.assert_allclose(sensor.angular_velocity, rate, atol=1e-9)
        np.testing.assert_allclose(sensor.acceleration, force, atol=1e-9)


def test_a_folder_of_synchronized_sensors_has_a_common_time(tmp_path: Path) -> None:
    q = np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))
    columns = "Quat_W,Quat_X,Quat_Y,Quat_Z"
    # The 32-bit time of the first file wraps in the recording. The second file begins afterwards.
    written(tmp_path / "a.csv", columns, q, first=2**32 - 2 * PERIOD_US, tag="Thigh")
    written(tmp_path / "b.csv", columns, q, first=PERIOD_US, tag="Shank")
    thigh, shank = read_session(tmp_path).sensors
    assert (thigh.id, shank.id) == ("Thigh", "Shank")
    np.testing.assert_allclose(thigh.t_s, 1e-6 * PERIOD_US * np.arange(ROWS))
    np.testing.assert_allclose(shank.t_s, 1e-6 * PERIOD_US * (3 + np.arange(ROWS)))


def test_sensors_without_synchronization_begin_together_and_say_so(tmp_path: Path) -> None:
    q = np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))
    columns = "Quat_W,Quat_X,Quat_Y,Quat_Z"
    written(tmp_path / "a.csv", columns, q, first=7)
    written(tmp_path / "b.csv", columns, q, first=900_000_000, sync="Not synced")
    session = read_session(tmp_path)
    assert [sensor.id for sensor in session.sensors] == ["a", "b"]  # both have the tag Thigh
    assert [sensor.t_s[0] for sensor in session.sensors] == [0.0, 0.0]
    assert "not Synced" in session.description["synchronization"]


def test_a_file_without_signal_or_with_rows_in_disorder_is_refused(tmp_path: Path) -> None:
    none = written(tmp_path / "none.csv", "Status", np.zeros((ROWS, 1)))
    with pytest.raises(MalformedFileError, match="record in another measurement mode"):
        read_session(none)

    path = written(tmp_path / "swapped.csv", "Euler_X,Euler_Y,Euler_Z", np.zeros((ROWS, 3)))
    lines = path.read_text().splitlines()
    lines[-1], lines[-2] = lines[-2], lines[-1]
    path.write_text("\n".join(lines))
    with pytest.raises(MalformedFileError, match="time does not increase from row"):
        read_session(path)
