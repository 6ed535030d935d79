"""The ``[[imu]]`` table of an Xbus device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, field_validator
from typing_extensions import override

from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_drivers.xbus._required_outputs import message_bytes, required_outputs
from jointfit_drivers.xbus._sync_lines import XbusSyncSettings  # noqa: TC001 - pydantic reads it

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_RATE_HZ = 400
"""Highest output rate of orientation of the supported devices, Hz."""


class XbusSettings(GatewaySettings, SerialImuSettings):
    """One Xsens / Movella IMU on a serial port or USB."""

    persist: bool = Field(
        False,
        description="write the output configuration into the device if it differs; the device "
        "stores every write in its flash at once",
    )
    world: Literal["ENU", "NED", "NWU"] = Field(
        "ENU",
        description="world that `persist` writes into the device; every message names its world, "
        "so the driver decodes all worlds",
    )
    sync: tuple[XbusSyncSettings, ...] | None = Field(
        None,
        description="functions of all sync lines of the device; written only if they differ and "
        "`persist` permits it. Default: unchanged",
    )
    reset_if_stuck: bool = Field(
        False, description="reset a device that streams but does not answer; its clock restarts"
    )

    bus_id: int | None = Field(
        None,
        ge=0,
        le=0xFF,
        description="bus id of the device whose measurements are used, on a line with several "
        "devices (Xbus master); default: the first device that sends",
    )
    format: Literal["mtdata2", "mtdata"] = Field(
        "mtdata2",
        description="message of the measurements: `mtdata2`, or `mtdata` of older devices, whose "
        "configuration is read and never written",
    )
    output_mode: int | None = Field(
        None,
        ge=0,
        le=0xFFFF,
        description="fields of MTData messages; default: as the device reports them. Set it for a "
        "capture without this report",
    )
    output_settings: int | None = Field(
        None,
        ge=0,
        le=0xFFFF_FFFF,
        description="format of MTData messages; default: as the device reports it",
    )
    legacy_world: Literal["NWU", "ENU"] = Field(
        "NWU",
        description="world of MTData messages, unless the output settings select NED: `NWU` for "
        "MTi and MTx of the first generations, `ENU` for later devices",
    )

    @override
    def contradictions(self) -> Iterable[tuple[str, str]]:
        """Yield the keys that do not fit the configured `format`, each with its fault."""
        yield from super().contradictions()
        if self.format != "mtdata":
            for key in ("output_mode", "output_settings"):
                if getattr(self, key) is not None:
                    yield key, 'only MTData has this key: set format = "mtdata", or remove the key'
            return
        if self.orientation == "gateway":
            yield "orientation", 'MTData has no device time: set orientation = "device"'
        if self.persist:
            yield "persist", "the configuration of MTData is never written: remove it"
        if self.sync is not None:
            yield "sync", "sync lines need MTData2: remove it"

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        outputs = required_outputs(self.orientation, magnetometer=self.magnetometer)
        return self.rate_hz * 10 * message_bytes(outputs)

    @field_validator("rate_hz")
    @classmethod
    def _rate_the_device_can_run_at(cls, rate_hz: float) -> float:
        """Reject rates that are not an integer number of Hz, or are above `MAX_RATE_HZ`."""
        if rate_hz != int(rate_hz) or rate_hz > MAX_RATE_HZ:
            raise ValueError(f"expected whole Hz up to {MAX_RATE_HZ}, found {rate_hz:g}")
        return rate_hz
