"""Conversion of the replies and messages of an x-IMU3, except measurements, to events."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent
from jointfit_protocols.ximu3 import DataKind

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded
    from jointfit_protocols.orientation import World
    from jointfit_protocols.ximu3 import XImu3Data, XImu3Reply

WORLDS: tuple[World, ...] = ("NWU", "ENU", "NED")
"""World for each value of ``ahrs_axes_convention``."""
ALIGNMENTS = (
    "+X+Y+Z", "+X-Z+Y", "+X-Y-Z", "+X+Z-Y", "-X+Y-Z", "-X+Z+Y", "-X-Y+Z", "-X-Z-Y",
    "+Y-X+Z", "+Y-Z-X", "+Y+X-Z", "+Y+Z+X", "-Y+X+Z", "-Y-Z+X", "-Y-X-Z", "-Y+Z-X",
    "+Z+Y-X", "+Z+X+Y", "+Z-Y+X", "+Z-X-Y", "-Z+Y+X", "-Z-X+Y", "-Z-Y-X", "-Z+X-Y",
)  # fmt: skip
"""Sensor axes that equal the body axes x, y and z, for each value of ``axes_alignment``."""
_PROPERTIES = {
    "firmware_version": "firmware",
    "hardware_version": "hardware",
    "device_name": "name",
    "serial_number": "serial",
}
_SETTINGS = (
    "ahrs_message_type", "ahrs_message_rate_divisor", "inertial_message_rate_divisor",
    "magnetometer_message_rate_divisor", "serial_mode", "ahrs_ignore_magnetometer",
)  # fmt: skip
_LOW_PERCENT = 10.0
"""Battery charge below which a warning is returned, percent."""
_CHARGED_PERCENT = 20.0
"""Battery charge above which the next warning is possible, percent."""
_LONGEST_TEXT = 200
"""Largest number of characters of a device's text in an event."""


class DeviceReports:
    """State of one device, as reported by its messages.

    Parameters
    ----------
    world : {"NWU", "ENU", "NED"}
        World that is assumed until the device reports its own.
    """

    def __init__(self, world: World) -> None:
        self.world: World = world
        """World of the orientations."""
        self._world_known = self._low = False

    def reply_events(self, reply: XImu3Reply) -> list[Decoded]:
        """Return the events that a reply to a command causes."""
        key, value = reply.key, reply.value
        if reply.error is not None:
            text = f"command {_text_of(key)} refused: {_text_of(reply.error)}"
            return [DeviceEvent("warning", text, {"command": key, "error": reply.error})]

        if key == "ping" and isinstance(value, dict):
            names = {"name": "name", "sn": "serial", "interface": "interface"}
            known: dict[str, object] = {"model": "x-IMU3"}
            known |= {name: _text_of(value[key]) for key, name in names.items() if key in value}
            return _properties(known)
        if key == "ahrs_axes_convention":
            return self._world_events(value)
        if key == "axes_alignment" and type(value) is int and 0 <= value < len(ALIGNMENTS):
            out = _properties({key: value})
            if value:
                text = (
                    f"axes_alignment is {value} ({ALIGNMENTS[value]}): the sensor axes are not "
                    "those printed on the housing"
                )
                out.append(DeviceEvent("warning", text, {key: value}))
            return out
        if key in _PROPERTIES:
            return _properties({_PROPERTIES[key]: _text_of(value)})
        return _properties({key: value} if key in _SETTINGS and isinstance(value, int) else {})

    def data_events(self, message: XImu3Data) -> list[Decoded]:
        """Return the events of a data message without measurement; most messages cause none."""
        text = _text_of(message.text.decode("utf-8", "replace"))
        if message.kind == DataKind.ERROR:
            return [DeviceEvent("error", f"device reports: {text}", {"error": text})]
        if message.kind == DataKind.NOTIFICATION:
            return [DeviceEvent("info", f"device reports: {text}", {"notification": text})]
        if message.kind != DataKind.BATTERY:
            return []

        # Warn when the battery charge falls below the limit.
        percent = message.values[0]
        low = percent < (_CHARGED_PERCENT if self._low else _LOW_PERCENT)
        fell, self._low = low and not self._low, low
        if not fell:
            return []
        text = f"battery {percent:.0f} %: charge it, or connect USB"
        return [DeviceEvent("warning", text, {"battery_percent": percent})]

    def _world_events(self, value: object) -> list[Decoded]:
        if type(value) is not int or not 0 <= value < len(WORLDS):
            text = (
                f"ahrs_axes_convention is {_text_of(value)}, expected 0, 1 or 2: using {self.world}"
            )
            return [DeviceEvent("warning", text)]
        world, before, known = WORLDS[value], self.world, self._world_known
        self.world, self._world_known = world, True
        if known and world != before:
            return [DeviceEvent("setting", f"world changed from {before} to {world}")]
        return _properties({"world": world})


def _properties(known: dict[str, object]) -> list[Decoded]:
    text = ", ".join(f"{key} {value}" for key, value in known.items())
    return [DeviceEvent("info", text, known)] if known else []


def _text_of(value: object) -> str:
    """Return a value that the device sent, as text of limited length."""
    return str(value)[:_LONGEST_TEXT]
