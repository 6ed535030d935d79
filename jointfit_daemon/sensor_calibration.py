"""The table ``[imu.sensor_calibration]``, which contains the measured errors of one sensor.

`jointfit calibrate sensor` writes the table. A driver whose settings have the key
`sensor_calibration` corrects raw readings with this table before the orientations are computed.
The table is part of rig.toml. A recording therefore contains it, and a replay applies the same
correction.

Invariant: this module contains no code for a particular device model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from pydantic import Field, field_validator
from typing_extensions import override

from jointfit_daemon.driver import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable

Row = tuple[float, float, float]
Rows = tuple[Row, Row, Row]

LARGEST_CHANGE = 0.9
"""Largest plausible deviation of an element of a matrix from the identity."""


class SensorCalibrationSettings(Settings):
    """Errors of one sensor. The corrected vector is matrix · (measured vector - bias)."""

    date: str = Field(
        pattern=r"^\d{4}-\d{2}-\d{2}$",
        description="day of the calibration",
        examples=["2026-11-23"],
    )
    serial: str | None = Field(
        None,
        description="serial number of the calibrated sensor, if it reports one; another sensor on "
        "the port causes a warning",
    )
    gyroscope_bias_deg_s: Row | None = Field(
        None, description="angular rate at rest, sensor axes, deg/s"
    )
    gyroscope_matrix: Rows | None = Field(
        None,
        description="inverse scale factors of the gyroscope, and its axes relative to those of the "
        "accelerometer, by rows",
    )
    accelerometer_bias: Row | None = Field(
        None, description="bias of the acceleration, sensor axes, m/s²"
    )
    accelerometer_matrix: Rows | None = Field(
        None,
        description="inverse scale factors and non-orthogonality of the accelerometer, by rows",
    )
    magnetometer_bias: Row | None = Field(
        None, description="hard-iron offset, sensor axes, in the unit of the device"
    )
    magnetometer_matrix: Rows | None = Field(
        None, description="inverse soft iron and scale factors of the magnetometer, by rows"
    )

    @field_validator("gyroscope_matrix", "accelerometer_matrix", "magnetometer_matrix")
    @classmethod
    def _near_the_identity(cls, matrix: Rows | None) -> Rows | None:
        """Reject a matrix that deviates too far from the identity for a real sensor."""
        for row, values in enumerate(matrix or ()):
            for column, value in enumerate(values):
                if abs(value - (row == column)) > LARGEST_CHANGE:
                    raise ValueError(
                        f"row {row + 1}, column {column + 1} is {value:g}, expected "
                        f"{int(row == column)} ± {LARGEST_CHANGE:g}: repeat the calibration with "
                        "`jointfit calibrate sensor`"
                    )
        return matrix

    @override
    def contradictions(self) -> Iterable[tuple[str, str]]:
        for part in ("accelerometer", "magnetometer"):
            keys = (f"{part}_bias", f"{part}_matrix")
            for key, other in (keys, keys[::-1]):
                if getattr(self, key) is None and getattr(self, other) is not None:
                    yield key, f"is missing, and {other} is given: expected both, or neither"

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the calibrated sensor parts, such as the gyroscope."""
        gyroscope = (self.gyroscope_bias_deg_s, self.gyroscope_matrix)
        known = (*gyroscope, self.accelerometer_bias, self.magnetometer_bias)
        names = ("gyroscope", "gyroscope scale", "accelerometer", "magnetometer")
        return tuple(name for name, value in zip(names, known, strict=True) if value is not None)


@runtime_checkable
class CalibratableSettings(Protocol):
    """Settings of a driver whose raw readings can be calibrated."""

    @property
    def orientation(self) -> str:
        """``gateway`` if orientations are computed from raw readings, ``device`` otherwise."""

    @property
    def magnetometer(self) -> bool:
        """Whether the magnetometer is used."""

    @property
    def sensor_calibration(self) -> SensorCalibrationSettings | None:
        """Current calibration; None if there is none."""

    def for_readings(self) -> Any:
        """Return settings whose decoder returns each uncorrected reading as a sample.

        A sample contains angular rate and specific force. It also contains the magnetic field if
        the device sent the field with this reading. The orientation of the sample is the identity.
        """


def calibration_of(settings: object) -> SensorCalibrationSettings | None:
    """Return the calibration that a driver applies; None if there is none."""
    found = getattr(settings, "sensor_calibration", None)
    return found if isinstance(found, SensorCalibrationSettings) else None


def exchanged_sensor(settings: object, serial: object) -> str | None:
    """Return a warning if the calibration belongs to another serial number; None otherwise."""
    calibration = calibration_of(settings)
    if calibration is None or calibration.serial in {None, str(serial)}:
        return None
    return (
        f"the sensor has serial number {serial}, but its sensor_calibration of {calibration.date} "
        f"belongs to {calibration.serial}: connect that sensor, or repeat `jointfit calibrate "
        f"sensor {getattr(settings, 'id', '')}`"
    )
