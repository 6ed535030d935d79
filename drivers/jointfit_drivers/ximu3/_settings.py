"""The ``[[imu]]`` table of an x-IMU3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field
from typing_extensions import override

from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_protocols.ximu3 import BASE_RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

_QUATERNION_BYTES, _INERTIAL_BYTES, _MAGNETIC_BYTES = 26, 34, 22
"""Sizes of binary messages without escapes, bytes."""
_MAGNETIC_HZ = 20
"""Rate of the magnetometer, Hz."""


class XImu3Settings(GatewaySettings, SerialImuSettings):
    """One x-IMU3 on a serial port or USB."""

    passive: bool = Field(
        False,
        description="only listen: send nothing and read no settings. For boards that only send "
        "these messages, and for a line without the wire from host to device",
    )
    persist: bool = Field(
        False,
        description="write differing settings into the device and save them in its memory",
    )
    world: Literal["NWU", "ENU", "NED"] = Field(
        "NWU",
        description="with `passive`: world of the device (its `ahrs_axes_convention`); otherwise "
        "the driver reads the world from the device",
    )
    axes_alignment: int | None = Field(
        None,
        ge=0,
        le=23,
        description="required `axes_alignment` of the device; default: any value; it is reported",
    )
    ignore_magnetometer: bool | None = Field(
        None,
        description="required `ahrs_ignore_magnetometer` of the device; default: any value; it is "
        "reported",
    )
    sync_wire: int | None = Field(
        None, ge=0, description="number of the rig's sync wire at the sync input of the accessory"
    )
    sync_edge: Literal["rising", "falling"] = Field("rising", description="edge that is used")

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        if self.orientation == "device":
            return 10 * _QUATERNION_BYTES * self.rate_hz
        field = _MAGNETIC_BYTES * _MAGNETIC_HZ if self.magnetometer else 0
        return 10 * (_INERTIAL_BYTES * self.rate_hz + field)

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield rates that the device does not support, and keys that `passive` cannot check."""
        rate_hz: float | None = self.rate_hz  # None: key cannot be read
        passive: bool | None = self.passive
        if rate_hz is not None and passive is False and rate_divisor(rate_hz) is None:
            near = sorted({BASE_RATE_HZ / divisor for divisor in nearest_divisors(rate_hz)})
            rates = " or ".join(f"{rate:.6g}" for rate in near)
            yield "rate_hz", f"expected {BASE_RATE_HZ} Hz divided by a whole number: {rates} Hz"
        if passive:
            checked = {
                "persist": self.persist or None,
                "axes_alignment": self.axes_alignment,
                "ignore_magnetometer": self.ignore_magnetometer,
            }
            for key, value in checked.items():
                if value is not None:
                    yield key, "a passive driver sends nothing: remove this key or `passive`"


def rate_divisor(rate_hz: float) -> int | None:
    """Return the divisor of the base rate for an output rate; None if no divisor fits."""
    divisor = round(BASE_RATE_HZ / rate_hz)
    exact = divisor >= 1 and abs(divisor * rate_hz / BASE_RATE_HZ - 1.0) < _TOLERANCE
    return divisor if exact else None


def nearest_divisors(rate_hz: float) -> tuple[int, int]:
    """Return the divisors for the next higher and the next lower possible rate."""
    divisor = max(int(BASE_RATE_HZ / rate_hz), 1)
    return divisor, divisor + 1 if rate_hz < BASE_RATE_HZ else divisor


_TOLERANCE = 1e-3
"""Largest relative difference between a configured rate and the fraction of the base rate that it
stands for. For example, 133.3 stands for 400/3."""
