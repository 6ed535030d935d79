"""Keys of an ``[[imu]]`` table whose device can send raw measurements."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from jointfit_daemon.driver import ImuSettings
from jointfit_drivers.gateway_orientation._filter import (
    LONGEST_SETTLE_S,
    PACKAGE_MISSING,
    is_installed,
)


class GatewaySettings(ImuSettings):
    """Choice between the orientation of the device and that of the gateway."""

    orientation: Literal["device", "gateway"] = Field(
        "device",
        description="computed by the `device`, or by the `gateway` from raw rates of turn and "
        "accelerations (needs the extra `vqf`); the same choice for all IMUs of a rig is best",
    )
    magnetometer: bool = Field(
        False,
        description='with `orientation = "gateway"`: heading by magnetometer, which the device '
        "must then send at `rate_hz`, too; left out it drifts freely. The same for all IMUs",
    )
    settle_s: float = Field(
        LONGEST_SETTLE_S,
        ge=0,
        le=60,
        description='with `orientation = "gateway"`: longest time, s, after the start (or a gap) '
        "without output while the orientation is uncertain; 1.5 s at rest",
    )

    @field_validator("orientation")
    @classmethod
    def _filter_that_is_installed(cls, orientation: str) -> str:
        """Refuse a missing package before the port is opened."""
        if orientation == "gateway" and not is_installed():
            raise ValueError(PACKAGE_MISSING)
        return orientation

    @field_validator("magnetometer")
    @classmethod
    def _magnetometer_of_a_filter(cls, magnetometer: bool, info: ValidationInfo) -> bool:
        """Refuse a magnetometer without a filter on the gateway."""
        if magnetometer and info.data.get("orientation") == "device":
            raise ValueError('needs orientation = "gateway": a device uses its own as it is set')
        return magnetometer
