"""Content of the table ``[imu.sensor_calibration]``, and its insertion in a rig.toml.

Only the lines of this table change; comments and the order of the file remain. The changed text is
parsed and compared with the expected content before `insert_table` returns it.
"""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.calibration.inertial_sensor import (
    GyroscopeEstimate,
    GyroscopeScaleEstimate,
)
from jointfit_daemon.sensor_calibration import SensorCalibrationSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import Estimate

KEY = "sensor_calibration"
_IMU = re.compile(r"\s*\[\[\s*imu\s*\]\]")
_PART_OF_IMU = re.compile(r"\s*\[{1,2}\s*imu\s*\.")
_OWN = re.compile(rf"\s*\[\s*imu\s*\.\s*{KEY}\s*\]")
_HEADER = re.compile(r"\s*\[{1,2}\s*[\w.\s\"'-]+\]{1,2}\s*(#.*)?$")


def make_calibration(
    estimates: Mapping[str, Estimate],
    date: str,
    serial: str | None,
    before: SensorCalibrationSettings | None,
) -> SensorCalibrationSettings:
    """Return the calibration of a sensor; `before` provides the parts without an estimate.

    If the serial number shows that `before` belongs to another sensor, `before` is ignored.
    """
    values: dict[str, Any] = {}
    if before is not None and before.serial in {None, serial}:
        values = before.model_dump(exclude_none=True)
    values |= {"date": date, "serial": serial}
    for part, estimate in estimates.items():
        if isinstance(estimate, GyroscopeEstimate):
            values["gyroscope_bias_deg_s"] = _round_values(np.rad2deg(estimate.bias))
            continue
        if isinstance(estimate, GyroscopeScaleEstimate):
            values["gyroscope_matrix"] = tuple(_round_values(row) for row in estimate.matrix)
            continue
        values[f"{part}_bias"] = _round_values(estimate.bias)
        values[f"{part}_matrix"] = tuple(_round_values(row) for row in estimate.matrix)
    return SensorCalibrationSettings.model_validate(values)


def table_lines(calibration: SensorCalibrationSettings) -> list[str]:
    """Return the lines of the table ``[imu.sensor_calibration]``."""
    lines = [f"[imu.{KEY}]"]
    for key, value in calibration.model_dump(exclude_none=True).items():
        text = f'"{value}"' if isinstance(value, str) else str(_lists(value))
        lines.append(f"{key} = {text}")
    return lines


def insert_table(text: str, name: str, calibration: SensorCalibrationSettings) -> str | None:
    """Return the text of a rig.toml with the table of a sensor; None if the text cannot be edited.

    Parameters
    ----------
    text
        Text of a valid rig.toml.
    name
        Id of the sensor.
    calibration
        Calibration of the sensor, which replaces an older calibration.
    """
    wanted = tomllib.loads(text)
    numbers = [at for at, imu in enumerate(wanted["imu"]) if imu.get("id") == name]
    lines = text.split("\n")
    begins = [at for at, line in enumerate(lines) if _IMU.match(line)]
    if len(numbers) != 1 or len(begins) != len(wanted["imu"]):
        return None

    # The table of the sensor ends at the next header that is not part of this table.
    begin = begins[numbers[0]]
    end = begin + 1
    while end < len(lines) and not (
        _HEADER.match(lines[end]) and not _PART_OF_IMU.match(lines[end])
    ):
        end += 1
    kept = _without_own(lines[begin:end])
    kept = kept[: len(kept) - _trailing(kept)]
    rest = lines[end - _trailing(lines[begin:end]) :]
    new = "\n".join([*lines[:begin], *kept, "", *table_lines(calibration), *(rest or [""])])

    wanted["imu"][numbers[0]][KEY] = tomllib.loads("\n".join(table_lines(calibration)))["imu"][KEY]
    try:
        return new if tomllib.loads(new) == wanted else None
    except tomllib.TOMLDecodeError:
        return None


def _without_own(lines: list[str]) -> list[str]:
    """Return the lines of a sensor's table without the lines of the old calibration."""
    out: list[str] = []
    inside = False
    for line in lines:
        if _HEADER.match(line):
            inside = _OWN.match(line) is not None
        if not inside:
            out.append(line)
    return out


def _trailing(lines: list[str]) -> int:
    """Return the number of empty lines and comments at the end of `lines`."""
    count = 0
    while count < len(lines) and (
        not lines[-1 - count].strip() or lines[-1 - count].lstrip().startswith("#")
    ):
        count += 1
    return count


def _round_values(values: Array) -> tuple[float, ...]:
    return tuple(float(f"{value:.6g}") for value in values)


def _lists(value: object) -> object:
    return [_lists(each) for each in value] if isinstance(value, tuple) else value
