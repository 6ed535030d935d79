"""The ``[[imu]]`` table of an Xbus device. Law: what a user may set, and nothing that runs."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from jointfit_daemon.driver import ImuSettings
from jointfit_drivers.xbus_sync import XbusSyncSettings  # noqa: TC001 - pydantic reads it

MAX_RATE_HZ = 400


class XbusSettings(ImuSettings):
    """One Xsens / Movella IMU on a serial port or USB."""

    port: str = Field(description="serial port, best a link under /dev/serial/by-id")
    baud: int = Field(115_200, gt=0, description="speed the device runs at, baud")
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
        description="world asked of the device when `persist` writes; every message says its own, "
        "so any is understood",
    )
    sync: tuple[XbusSyncSettings, ...] | None = Field(
        None,
        description="what its sync lines do, all of them; written only where they differ and "
        "`persist` allows it. Left out: they stay as they are",
    )
    reset_if_stuck: bool = Field(
        False, description="reset a device that streams but does not answer; its clock restarts"
    )

    @field_validator("rate_hz")
    @classmethod
    def _rate_the_device_can_run_at(cls, rate_hz: float) -> float:
        """Refuse what cannot be written as whole Hz."""
        if rate_hz != int(rate_hz) or rate_hz > MAX_RATE_HZ:
            raise ValueError(f"whole Hz up to {MAX_RATE_HZ}, found {rate_hz:g}")
        return rate_hz
