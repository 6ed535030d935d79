"""Keys of an ``[[imu]]`` table for a device that can send raw measurements."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, PrivateAttr, ValidationInfo, field_validator

from jointfit_daemon.driver import ImuSettings
from jointfit_daemon.sensor_calibration import (
    SensorCalibrationSettings,  # noqa: TC001 - pydantic reads it
)
from jointfit_drivers.gateway_orientation._filter import (
    LONGEST_SETTLE_S,
    PACKAGE_MISSING,
    is_installed,
)


class GatewaySettings(ImuSettings):
    """Choice whether the device or the gateway computes the orientation."""

    orientation: Literal["device", "gateway"] = Field(
        "device",
        description="computed by the `device`, or by the `gateway` from raw rates of turn and "
        "accelerations (needs the extra `vqf`); the same choice for all IMUs of a rig is best",
    )
    magnetometer: bool = Field(
        False,
        description='with `orientation = "gateway"`: take the heading from the magnetometer; the '
        "device must then also send its magnetometer readings at `rate_hz`. Without magnetometer "
        "the heading drifts. Use the same value for all IMUs of a rig",
    )
    settle_s: float = Field(
        LONGEST_SETTLE_S,
        ge=0,
        le=60,
        description='with `orientation = "gateway"`: longest time without samples after a start '
        "or a gap, s, while the orientation is uncertain (without magnetometer at most 3 s). At "
        "rest, samples can begin after 1.5 s",
    )
    sensor_calibration: SensorCalibrationSettings | None = Field(
        None,
        description='with `orientation = "gateway"`: errors of the sensor, written by `jointfit '
        "calibrate sensor`",
    )
    _readings_only: bool = PrivateAttr(default=False)

    @property
    def readings_only(self) -> bool:
        """Whether the decoder returns uncorrected readings, as `for_readings` describes."""
        return self._readings_only

    def for_readings(self) -> Self:
        """Return settings whose decoder returns each uncorrected reading as a sample."""
        copy = self.model_copy()
        copy._readings_only = True  # noqa: SLF001 - of the same class
        return copy

    @field_validator("orientation")
    @classmethod
    def _filter_that_is_installed(cls, orientation: str) -> str:
        """Reject ``gateway`` before a port is opened if the filter package is missing."""
        if orientation == "gateway" and not is_installed():
            raise ValueError(PACKAGE_MISSING)
        return orientation

    @field_validator("sensor_calibration")
    @classmethod
    def _calibration_of_readings(
        cls, found: SensorCalibrationSettings | None, info: ValidationInfo
    ) -> SensorCalibrationSettings | None:
        """Reject a calibration of raw readings if the readings are not used."""
        if found is not None and info.data.get("orientation") == "device":
            raise ValueError(
                'needs orientation = "gateway": the device computes its orientation from '
                "uncorrected readings. Set this value, or remove this table"
            )
        return found

    @field_validator("magnetometer")
    @classmethod
    def _magnetometer_of_a_filter(cls, magnetometer: bool, info: ValidationInfo) -> bool:
        """Reject the key if the device computes the orientation."""
        if magnetometer and info.data.get("orientation") == "device":
            raise ValueError(
                'needs orientation = "gateway": with "device", the settings of the device decide '
                "whether it uses its magnetometer"
            )
        return magnetometer
