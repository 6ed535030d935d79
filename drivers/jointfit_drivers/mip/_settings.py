"""The ``[[imu]]`` table of a MIP device."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from typing_extensions import override

from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_drivers.mip._required_fields import RequiredFields, required_fields
from jointfit_drivers.serial_imu import SerialImuSettings


class MipSettings(GatewaySettings, SerialImuSettings):
    """One MicroStrain IMU on a serial port or USB."""

    estimator: Literal["filter", "sensor"] = Field(
        "filter",
        description="source of the device's orientation: its estimation `filter` (data set 0x82) "
        "or the complementary filter of its `sensor` (0x80), which some models have instead",
    )
    family: Literal["auto", "current", "legacy"] = Field(
        "auto",
        description="commands of the device: `current` (CV7, GV7, GQ7), `legacy` (GX5, CX5, CV5 "
        "and older); `auto`: as the device reports",
    )
    persist: bool = Field(
        False,
        description="save changed settings in the device; otherwise they last until the device "
        "is switched off, and are sent again at the next start",
    )

    @property
    def required(self) -> RequiredFields:
        """Fields that the device must send."""
        return required_fields(self.orientation, self.estimator, magnetometer=self.magnetometer)

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        return self.rate_hz * 10 * self.required.packet_bytes
