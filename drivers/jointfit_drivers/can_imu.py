"""Settings of the connection of an IMU to a CAN bus."""

from __future__ import annotations

from pydantic import Field, field_validator

from jointfit_daemon.driver import CanBusError, CanBusSettings, ImuSettings
from jointfit_drivers.ports.can_bus import bus_faults


class CanImuSettings(ImuSettings):
    """Connection of an IMU on a CAN bus."""

    can: CanBusSettings = Field(description="name of the [can.NAME] table of the sensor's bus")

    @field_validator("can")
    @classmethod
    def _bus_that_exists_here(cls, can: CanBusSettings) -> CanBusSettings:
        if faults := bus_faults(can):
            raise CanBusError(faults)
        return can
