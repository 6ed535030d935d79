"""The ``[[imu]]`` table of a VectorNav device."""

from __future__ import annotations

from typing import Literal

from pydantic import Field as SettingsField
from typing_extensions import override

from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_protocols.vectornav import BinaryLayout, Field, Fields

_FRAME_BYTES = 3
"""Number of bytes of a message without its header and payload: sync byte and CRC."""
_ORIENTATION = (Field.TIME_STARTUP, Field.QUATERNION)
_RAW = (Field.TIME_STARTUP, Field.ANGULAR_RATE, Field.ACCELERATION)


class VectorNavSettings(GatewaySettings, SerialImuSettings):
    """One VectorNav IMU on a serial port or USB."""

    output: Literal[1, 2, 3] = SettingsField(
        1, description="number of the binary output that the driver uses (registers 75 to 77)"
    )
    persist: bool = SettingsField(
        False,
        description="store changed registers in the device; otherwise they last until it is "
        "switched off, and are sent again at the next start",
    )
    direction: Literal["sensor_to_world", "world_to_sensor"] = SettingsField(
        "sensor_to_world",
        description="whether the quaternion maps sensor to world coordinates (as in the manual), "
        "or the reverse; see the test of the frames in docs/diagnosis.md",
    )

    @property
    def required(self) -> Fields:
        """Fields that the device must send in one message."""
        if self.orientation == "device":
            return BinaryLayout(_ORIENTATION).fields
        field = (Field.MAGNETIC_AND_PRESSURE,) if self.magnetometer else ()
        return BinaryLayout((*_RAW, *field)).fields

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        layout = BinaryLayout(self.required)
        return self.rate_hz * 10 * (_FRAME_BYTES + len(layout.header) + layout.struct.size)
