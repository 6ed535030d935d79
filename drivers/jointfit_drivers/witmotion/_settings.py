"""The ``[[imu]]`` table of a WitMotion device."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator
from typing_extensions import override

from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_protocols.witmotion import FRAME_BYTES, RATE_CODES, WitMotionFrameKind

_BITS = 10
"""Number of bits of one byte on the line (8N1)."""


class WitMotionSettings(SerialImuSettings, GatewaySettings):
    """One WitMotion IMU on a serial port."""

    world: Literal["ENU", "NED", "NWU"] = Field(
        "ENU",
        description="directions of the x, y and z axes of the device's world: E east, N north, W "
        "west, U up, D down; the vendor does not document them, `jointfit probe --physical-test` "
        "determines them",
    )
    direction: Literal["sensor_to_world", "world_to_sensor"] = Field(
        "sensor_to_world",
        description="whether the device's quaternion maps sensor to world coordinates, or the "
        "reverse; the vendor does not document the direction, `jointfit probe --physical-test` "
        "determines it",
    )
    device_time: bool = Field(
        False,
        description="stamp samples with the calendar time that the device sends with every "
        "sample; default: time of arrival",
    )
    persist: bool = Field(
        False,
        description="store changed settings in the device's flash; also permits the driver "
        "to change the device's line speed to `baud`",
    )

    @property
    def kinds(self) -> tuple[WitMotionFrameKind, ...]:
        """Kinds of frames of one sample, in the order in which the device sends them."""
        if self.orientation == "gateway":
            kinds = (
                WitMotionFrameKind.TIME,
                WitMotionFrameKind.ACCELERATION,
                WitMotionFrameKind.RATE,
            )
            return (*kinds, WitMotionFrameKind.MAGNETIC_FIELD) if self.magnetometer else kinds
        if self.device_time:
            return (WitMotionFrameKind.TIME, WitMotionFrameKind.QUATERNION)
        return (WitMotionFrameKind.QUATERNION,)

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        return self.rate_hz * _BITS * FRAME_BYTES * len(self.kinds)

    @field_validator("rate_hz")
    @classmethod
    def _rate_with_a_code(cls, rate_hz: float) -> float:
        """Reject rates for which the device has no setting."""
        if rate_hz not in RATE_CODES:
            known = ", ".join(map(str, RATE_CODES))
            raise ValueError(f"expected one of {known} Hz, found {rate_hz:g}")
        return rate_hz
