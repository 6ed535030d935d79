"""The ``[[imu]]`` table of an Xbus device."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator
from typing_extensions import override

from jointfit_daemon.driver import FASTEST_BAUD, SLOWEST_BAUD, ImuSettings, port_path_fault
from jointfit_drivers import gateway_orientation
from jointfit_drivers.xbus._required_outputs import message_bytes, required_outputs
from jointfit_drivers.xbus._sync_lines import XbusSyncSettings  # noqa: TC001 - pydantic reads it

MAX_RATE_HZ = 400
"""Highest output rate of orientation of the supported devices, Hz."""


class XbusSettings(ImuSettings):
    """One Xsens / Movella IMU on a serial port or USB."""

    port: str = Field(description="serial port, preferably a link under /dev/serial/by-id")
    baud: int = Field(
        115_200, ge=SLOWEST_BAUD, le=FASTEST_BAUD, description="speed the device runs at, baud"
    )
    transport: Literal["uart", "usb"] = Field(
        "uart",
        description="`uart`: a line at `baud`, also behind a USB bridge; stamps are back-dated by "
        "the bytes that came. `usb`: the device's own USB port, where bytes take no time",
    )
    persist: bool = Field(
        False,
        description="write a differing output configuration into the device; every write is "
        "stored in its flash at once",
    )
    world: Literal["ENU", "NED", "NWU"] = Field(
        "ENU",
        description="world that `persist` writes into the device; every message names its own, "
        "so any is decoded",
    )
    sync: tuple[XbusSyncSettings, ...] | None = Field(
        None,
        description="functions of all its sync lines; written only where they differ and "
        "`persist` allows it. Default: unchanged",
    )
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
        gateway_orientation.LONGEST_SETTLE_S,
        ge=0,
        le=60,
        description='with `orientation = "gateway"`: longest time, s, after the start (or a gap) '
        "without output while the orientation is uncertain; 1.5 s at rest",
    )
    reset_if_stuck: bool = Field(
        False, description="reset a device that streams but does not answer; its clock restarts"
    )

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        outputs = required_outputs(self.orientation, magnetometer=self.magnetometer)
        return self.rate_hz * 10 * message_bytes(outputs)

    @field_validator("port")
    @classmethod
    def _port_with_a_name(cls, port: str) -> str:
        if (fault := port_path_fault(port)) is not None:
            raise ValueError(fault)
        return port

    @field_validator("rate_hz")
    @classmethod
    def _rate_the_device_can_run_at(cls, rate_hz: float) -> float:
        """Refuse rates that are no whole number of Hz."""
        if rate_hz != int(rate_hz) or rate_hz > MAX_RATE_HZ:
            raise ValueError(f"whole Hz up to {MAX_RATE_HZ}, found {rate_hz:g}")
        return rate_hz

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
