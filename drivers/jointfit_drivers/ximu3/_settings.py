"""The ``[[imu]]`` table of an x-IMU3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, ValidationInfo, field_validator
from typing_extensions import override

from jointfit_daemon.driver import FASTEST_BAUD, SLOWEST_BAUD, ImuSettings, port_path_fault
from jointfit_drivers import gateway_orientation
from jointfit_protocols.ximu3 import BASE_RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

_QUATERNION_BYTES, _INERTIAL_BYTES, _MAGNETIC_BYTES = 26, 34, 22
"""Binary messages without escapes."""
_MAGNETIC_HZ = 20
"""Rate of the magnetometer."""


class XImu3Settings(ImuSettings):
    """One x-IMU3 on a serial port or USB."""

    port: str = Field(description="serial port, preferably a link under /dev/serial/by-id")
    baud: int = Field(
        115_200, ge=SLOWEST_BAUD, le=FASTEST_BAUD, description="speed the device runs at, baud"
    )
    transport: Literal["uart", "usb"] = Field(
        "uart",
        description="`uart`: the device's serial interface at `baud`, also behind a USB bridge; "
        "stamps are back-dated by the bytes that came. `usb`: the device's own USB port",
    )
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
        "it is read from the device",
    )
    axes_alignment: int | None = Field(
        None,
        ge=0,
        le=23,
        description="required `axes_alignment` of the device; default: any, which is reported",
    )
    ignore_magnetometer: bool | None = Field(
        None,
        description="required `ahrs_ignore_magnetometer` of the device; default: any, reported",
    )
    orientation: Literal["device", "gateway"] = Field(
        "device",
        description="computed by the `device`, or by the `gateway` from raw angular rates and "
        "accelerations (needs the extra `vqf`); the same choice for all IMUs of a rig is best",
    )
    magnetometer: bool = Field(
        False,
        description='with `orientation = "gateway"`: heading by magnetometer; left out it drifts '
        "freely. The same for all IMUs",
    )
    settle_s: float = Field(
        gateway_orientation.LONGEST_SETTLE_S,
        ge=0,
        le=60,
        description='with `orientation = "gateway"`: longest time, s, after the start (or a gap) '
        "without output while the orientation is uncertain; 1.5 s at rest",
    )
    sync_wire: int | None = Field(
        None, ge=0, description="number of the sync wire of the rig at its accessory's sync input"
    )
    sync_edge: Literal["rising", "falling"] = Field("rising", description="edge that counts")

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
        """Refuse rates that the device does not have, and settings that `passive` cannot check."""
        rate_hz: float | None = self.rate_hz  # None: cannot be read
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
                    yield key, "a passive driver sends nothing: remove the key, or passive"

    @field_validator("port")
    @classmethod
    def _port_with_a_name(cls, port: str) -> str:
        if (fault := port_path_fault(port)) is not None:
            raise ValueError(fault)
        return port

    @field_validator("orientation")
    @classmethod
    def _filter_that_is_installed(cls, orientation: str) -> str:
        """Refuse a missing package before the port is opened."""
        if orientation == "gateway" and not gateway_orientation.is_installed():
            raise ValueError(gateway_orientation.PACKAGE_MISSING)
        return orientation

    @field_validator("magnetometer")
    @classmethod
    def _magnetometer_of_a_filter(cls, magnetometer: bool, info: ValidationInfo) -> bool:
        """Refuse a magnetometer without a filter on the gateway."""
        if magnetometer and info.data.get("orientation") == "device":
            raise ValueError('needs orientation = "gateway": a device uses its own as it is set')
        return magnetometer


def rate_divisor(rate_hz: float) -> int | None:
    """Return the divisor of the base rate for an output rate; None if there is none."""
    divisor = round(BASE_RATE_HZ / rate_hz)
    exact = divisor >= 1 and abs(divisor * rate_hz / BASE_RATE_HZ - 1.0) < _TOLERANCE
    return divisor if exact else None


def nearest_divisors(rate_hz: float) -> tuple[int, int]:
    """Return the divisors of the next higher and the next lower rate."""
    divisor = max(int(BASE_RATE_HZ / rate_hz), 1)
    return divisor, divisor + 1 if rate_hz < BASE_RATE_HZ else divisor


_TOLERANCE = 1e-3
"""Relative difference between a configured rate and a fraction of the base rate: 133.3 is 400/3."""
