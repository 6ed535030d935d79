"""Settings that an x-IMU3 needs in order to send the measurements that rig.toml requests."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_drivers.ximu3._settings import rate_divisor
from jointfit_protocols.ximu3 import BASE_RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_drivers.ximu3._settings import XImu3Settings

WORLD = "ahrs_axes_convention"
REPORTED = (
    "firmware_version", "hardware_version", WORLD, "axes_alignment", "ahrs_ignore_magnetometer",
)  # fmt: skip
"""Settings that are always read, because the decoder reports or needs their values."""
_SERIAL_MODES = ("disabled", "normal", "accessory")
_MESSAGE_TYPES = (
    "quaternion", "rotation matrix", "Euler angles", "linear acceleration", "earth acceleration",
)  # fmt: skip
_MAGNETIC_DIVISORS = (1, 2)
"""Divisors of 20 Hz, the rate of the magnetometer. Its data are then sent at 20 or 10 Hz."""


class RequiredSetting(NamedTuple):
    """One setting and its acceptable values."""

    key: str
    values: tuple[object, ...]
    """Acceptable values. If the device has none of them, the driver writes the first."""


def required_settings(settings: XImu3Settings) -> tuple[RequiredSetting, ...]:
    """Return the settings that the device must have."""
    divisor = rate_divisor(settings.rate_hz)
    interface = (
        [RequiredSetting("usb_data_messages_enabled", (True,))]
        if settings.transport == "usb"
        else [
            RequiredSetting("serial_mode", (1,)),
            RequiredSetting("serial_data_messages_enabled", (True,)),
        ]
    )

    if settings.orientation == "device":
        # The decoder converts matrices and Euler angles to quaternions.
        measured = [
            RequiredSetting("ahrs_message_type", (0, 1, 2)),
            RequiredSetting("ahrs_message_rate_divisor", (divisor,)),
        ]
    else:
        measured = [RequiredSetting("inertial_message_rate_divisor", (divisor,))]
        if settings.magnetometer:
            measured.append(
                RequiredSetting("magnetometer_message_rate_divisor", _MAGNETIC_DIVISORS)
            )

    requested = (
        ("axes_alignment", settings.axes_alignment),
        ("ahrs_ignore_magnetometer", settings.ignore_magnetometer),
    )
    chosen = [RequiredSetting(key, (value,)) for key, value in requested if value is not None]
    return (*interface, *measured, *chosen)


def differences(
    found: Mapping[str, object], required: tuple[RequiredSetting, ...]
) -> dict[str, str]:
    """Return a description of each setting that differs, by key."""
    return {
        key: f"{key} is {describe_value(key, found.get(key))}, expected "
        f"{describe_value(key, values[0])}"
        for key, values in required
        # Both the value and its JSON type must be equal, because 1 == True in Python.
        if not any(
            found.get(key) == value and isinstance(found.get(key), bool) == isinstance(value, bool)
            for value in values
        )
    }


def rate_hint(found: Mapping[str, object], required: tuple[RequiredSetting, ...]) -> str:
    """Return a hint to use the device's rate as `rate_hz`, if this removes all differences."""
    faults = differences(found, required)
    key = next(iter(faults), "")
    divisor = found.get(key)
    if len(faults) != 1 or key not in _RATES or not isinstance(divisor, int) or divisor < 1:
        return ""
    return f" (or set rate_hz = {BASE_RATE_HZ / divisor:.6g})"


def describe_value(key: str, value: object) -> str:
    """Return a value of a setting as text with its meaning."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        names = {"serial_mode": _SERIAL_MODES, "ahrs_message_type": _MESSAGE_TYPES}.get(key, ())
        if 0 <= value < len(names):
            return f"{value} ({names[value]})"
        if key in _RATES:
            return f"{value} ({f'{BASE_RATE_HZ / value:.6g} Hz' if value > 0 else 'off'})"
    return "missing" if value is None else str(value)


_RATES = ("ahrs_message_rate_divisor", "inertial_message_rate_divisor")
"""Settings whose values are divisors of the base rate."""
