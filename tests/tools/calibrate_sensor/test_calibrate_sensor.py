"""`jointfit calibrate sensor` finds the sensor errors, and changes only one table of rig.toml."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import tomllib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from jointfit_daemon.config import load_rig
from jointfit_daemon.sensor_calibration import SensorCalibrationSettings
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.calibrate_sensor._calibration_table import (
    insert_table,
    make_calibration,
    table_lines,
)
from jointfit_daemon.tools.calibrate_sensor._guided_steps import (
    STEPS,
    SensorFindings,
    take_recorded,
)
from jointfit_daemon.tools.calibrate_sensor._sensor_report import report_data, report_lines
from tests.tools.calibrate_sensor.moved_device import (
    ACCELEROMETER_BIAS,
    ACCELEROMETER_SCALE,
    GYROSCOPE_BIAS_DEG_S,
    GYROSCOPE_SCALE,
    MAGNETOMETER_BIAS,
    MOVE_S,
    POSES,
    REST_S,
    RIG,
    SERIAL,
    held,
    recorded_chunks,
)

if TYPE_CHECKING:
    from pathlib import Path

COMMAND = ("-u", "-m", "jointfit_daemon.tools", "calibrate", "sensor", "S1")
POSES_S = len(POSES) * (REST_S + MOVE_S)
CALIBRATION = SensorCalibrationSettings(
    date="2026-11-23", serial=SERIAL, gyroscope_bias_deg_s=(1.0, 2.0, 3.0)
)


def assert_near_truth(table: dict[str, Any]) -> None:
    np.testing.assert_allclose(table["gyroscope_bias_deg_s"], GYROSCOPE_BIAS_DEG_S, atol=0.05)
    np.testing.assert_allclose(table["accelerometer_bias"], ACCELEROMETER_BIAS, atol=0.02)
    scales = 1.0 / np.diag(table["accelerometer_matrix"])
    np.testing.assert_allclose(scales * 9.80665 / 9.81, ACCELEROMETER_SCALE, atol=0.003)
    np.testing.assert_allclose(table["magnetometer_bias"], MAGNETOMETER_BIAS, atol=0.02)
    assert np.linalg.det(table["magnetometer_matrix"]) == pytest.approx(1.0, abs=1e-4)


def findings_of(tmp_path: Path, **durations: float) -> SensorFindings:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.format(port="/dev/ttyUSB0"), encoding="utf-8")
    source = load_rig(path).sources[0]
    return take_recorded(source, list(STEPS), recorded_chunks(durations))


def test_recorded_movements_yield_the_errors_of_the_sensor(tmp_path: Path) -> None:
    found = findings_of(tmp_path, gyroscope=7.0, accelerometer=POSES_S, magnetometer=40.0)
    assert found.refused == {}
    made = make_calibration(found.estimates, "2026-11-23", SERIAL, None)
    assert_near_truth(made.model_dump())
    scales = 1.0 / np.diag(np.array(made.gyroscope_matrix))
    np.testing.assert_allclose(scales, GYROSCOPE_SCALE, atol=0.004)
    assert "gyroscope scale" in made.parts

    text = "\n".join(report_lines("S1", found))
    assert "gyroscope: bias 1.50" in text
    assert "gyroscope scale: errors 1.5" in text
    assert "|a| differs from gravity by 0.3" in text
    assert "in 12 poses" in text
    data = json.loads(json.dumps(report_data("S1", found), default=lambda each: each.tolist()))
    assert data["magnetometer"]["residual"] < 0.02 < data["magnetometer"]["spread_before"]


def test_a_refused_step_keeps_the_others(tmp_path: Path) -> None:
    found = findings_of(tmp_path, gyroscope=7.0, accelerometer=6.0)
    assert list(found.estimates) == ["gyroscope"]
    assert "static poses, expected at least 9" in found.refused["accelerometer"]
    assert "of 26 directions" in found.refused["magnetometer"]
    assert "  magnetometer: refused: " in "\n".join(report_lines("S1", found))


# --- the table in rig.toml ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["S1", "S2"])
def test_only_the_table_of_the_sensor_changes(name: str) -> None:
    text = insert_table(RIG, name, CALIBRATION)
    assert text is not None
    added = "\n".join(table_lines(CALIBRATION))
    assert text.count("sensor_calibration") == 1
    assert text.replace("\n" + added + "\n", "") == RIG
    again = insert_table(text, name, CALIBRATION.model_copy(update={"date": "2026-12-01"}))
    assert again == text.replace("2026-11-23", "2026-12-01")
    imu = {imu["id"]: imu for imu in tomllib.loads(text)["imu"]}[name]
    assert SensorCalibrationSettings.model_validate_json(json.dumps(imu["sensor_calibration"])) == (
        CALIBRATION
    )


def test_another_sub_table_of_the_sensor_remains() -> None:
    rig = RIG.replace("\n# the second", "\n[imu.fields]\nrate = [\n  {a = 1},\n]\n\n# the second")
    text = insert_table(rig, "S1", CALIBRATION)
    assert text is not None
    assert text.index("[imu.fields]") < text.index("[imu.sensor_calibration]") < text.index("# the")


@pytest.mark.parametrize(
    "rig",
    [
        'imu = [{id = "S1"}]',
        '[[imu]]\nid = "S1"\nsensor_calibration = {date = "2020-01-01"}',
        '[[imu]]\nid = "S1"\ntext = """\n[[imu]]\n"""',
    ],
)
def test_a_file_that_cannot_be_edited_safely_is_left(rig: str) -> None:
    assert insert_table(rig, "S1", CALIBRATION) is None


def test_parts_of_the_same_sensor_are_kept_and_those_of_another_are_not() -> None:
    assert make_calibration({}, "2026-12-01", SERIAL, CALIBRATION).parts == ("gyroscope",)
    assert make_calibration({}, "2026-12-01", "77", CALIBRATION).parts == ()


# --- the command ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "options", "text"),
    [
        (("", ""), ["S7"], "no sensor 'S7'; did you mean 'S2'?"),
        (("", ""), ["S2"], "S2: its orientation comes from the device"),
        (
            ("", ""),
            ["S1", "--steps", "compass"],
            "expected gyroscope, accelerometer or magnetometer",
        ),
        (("", ""), ["S7", "--steps", "gyroscope,compas"], "--steps 'compas': expected gyroscope"),
        (
            ("magnetometer = true\n", ""),
            ["S1", "--steps", "magnetometer"],
            "does not use its magnet",
        ),
    ],
)
def test_wrong_options_are_refused_before_the_port_is_opened(
    tmp_path: Path, change: tuple[str, str], options: list[str], text: str
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.format(port=tmp_path / "absent").replace(*change), encoding="utf-8")
    result = CliRunner().invoke(app, ["calibrate", "sensor", *options, "--rig", str(path)])
    assert result.exit_code == 2
    assert text in result.output


def test_an_absent_sensor_ends_the_command_in_words(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.format(port=tmp_path / "absent"), encoding="utf-8")
    result = CliRunner().invoke(app, ["calibrate", "sensor", "S1", "--rig", str(path)])
    assert result.exit_code == 1
    assert f"jointfit calibrate sensor: S1: {tmp_path / 'absent'}" in result.output
    assert path.read_text(encoding="utf-8") == RIG.format(port=tmp_path / "absent")


async def run_command(folder: Path, hand: Any, *options: str, stop_at: str = "") -> tuple[int, str]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, *COMMAND, "--rig", str(folder / "rig.toml"), *options,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        # Restore the default: if a shell runs the tests in the background, they ignore SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None
    lines = []
    async for line in process.stdout:
        lines.append(line.decode())
        hand.follow(lines[-1])
        if stop_at and stop_at in lines[-1]:
            process.send_signal(signal.SIGINT)
    return await process.wait(), "".join(lines)


@pytest.mark.real_time
async def test_ctrl_c_leaves_rig_toml_and_no_other_file(tmp_path: Path) -> None:
    async with held(tmp_path) as hand:
        code, text = await run_command(tmp_path, hand, stop_at="Lay S1 on a table")
    assert code == 130
    assert "stopped by SIGINT: nothing was written" in text
    assert (tmp_path / "rig.toml").read_text(encoding="utf-8") == RIG.format(port=tmp_path / "imu")
    assert set(os.listdir(tmp_path)) - {"imu"} == {"rig.toml"}  # noqa: PTH208 - in a coroutine


@pytest.mark.real_time
@pytest.mark.experiment
@pytest.mark.timeout(300)
async def test_the_command_guides_and_writes_what_the_daemon_uses(tmp_path: Path) -> None:
    async with held(tmp_path) as hand:
        code, text = await run_command(tmp_path, hand)
    assert code == 0, text
    assert text.index("Lay S1 on a table") < text.index("six faces") < text.index("in your hand")
    assert "missing: " in text
    assert f"S1 (serial {SERIAL})" in text

    rig = load_rig(tmp_path / "rig.toml")
    table = rig.sources[0].settings.sensor_calibration
    assert table.serial == SERIAL
    assert_near_truth(table.model_dump())
    shown = CliRunner().invoke(app, ["check", str(tmp_path / "rig.toml")])
    assert f"S1: sensor calibration of {table.date}" in shown.output
