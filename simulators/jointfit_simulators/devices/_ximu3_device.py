"""Virtual x-IMU3 on a pseudo-terminal (pty), with the behaviour and faults of real devices.

Invariants: the serial interface is inactive until ``serial_mode`` is 1. The device sends
measurements continuously, and replies to every command with the key of the command. It activates
new settings after ``apply``. Its quaternions have the norm 1.000121. Source: x-IMU3-Software of
x-io Technologies (MIT), and its example log of a device.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain
from math import degrees
from typing import TYPE_CHECKING, Literal

from typing_extensions import override

from jointfit_daemon.units import STANDARD_GRAVITY
from jointfit_protocols.orientation import World, native_of
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.ximu3 import (
    BASE_RATE_HZ,
    TICK_NS,
    DataKind,
    XImu3Codec,
    XImu3Reply,
    encode_command,
    encode_data,
    encode_text,
)
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._rotations import roll_pitch_yaw_deg, rotation_rows
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_simulators.devices._sensor_errors import SensorErrors
    from jointfit_simulators.imu_device import Quaternion, WireNoise

NORM = 1.000121
"""Norm of the quaternions in the example log."""
_WORLDS: tuple[World, ...] = ("NWU", "ENU", "NED")
_FACTORY: dict[str, object] = {
    "device_name": "x-IMU3",
    "serial_number": "0123ABCD",
    "firmware_version": "v1.3.0",
    "hardware_version": "v2.0",
    "serial_mode": 0,
    "serial_baud_rate": 115_200,
    "serial_data_messages_enabled": True,
    "usb_data_messages_enabled": True,
    "binary_mode_enabled": True,
    "ahrs_message_type": 0,
    "ahrs_message_rate_divisor": 8,
    "inertial_message_rate_divisor": 8,
    "magnetometer_message_rate_divisor": 1,
    "ahrs_axes_convention": 0,
    "axes_alignment": 0,
    "ahrs_ignore_magnetometer": False,
}
_READ_ONLY = ("serial_number", "firmware_version", "hardware_version")
_MOST = {
    "serial_mode": 2, "ahrs_message_type": 4, "ahrs_axes_convention": 2, "axes_alignment": 23,
    "ahrs_message_rate_divisor": 400, "inertial_message_rate_divisor": 400,
    "magnetometer_message_rate_divisor": 20, "serial_baud_rate": 12_000_000,
}  # fmt: skip
"""Maximum value of each numeric setting."""
_ACTIONS = ("apply", "save", "strobe", "heading")
_ACCESSORY = 2
"""Value of ``serial_mode`` if an accessory uses the serial interface."""
_MAGNETIC_NS = 50_000_000
"""Time between two magnetometer messages at divisor 1, ns."""
_BATTERY_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class XImu3DeviceOptions:
    """Settings and faults of a device."""

    settings: Mapping[str, object] = field(default_factory=dict)
    """Stored settings that differ from the factory settings."""
    interface: Literal["Serial", "USB"] = "Serial"
    baud: int | None = None
    """Line speed of the device, bit/s. At another speed, both sides receive invalid bytes. None
    accepts any speed (USB)."""
    answers: bool = True
    """Whether the device answers commands. Otherwise, it simulates a board that only sends."""
    missing: tuple[str, ...] = ()
    """Settings that the firmware of the device lacks."""
    error: str = ""
    """Text of an error message that accompanies the first measurement; empty for no message."""
    battery_percent: float = 80.0
    first_tick: int = 0
    """Clock value at power-up, us."""
    errors: SensorErrors | None = None
    """Errors of the device's sensors; None for exact measurements."""


class XImu3Device(SerialDevice):
    """`ImuDevice` on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    options
        Settings and faults.
    wire_noise
        Noise applied to each message to the host.
    """

    def __init__(
        self,
        link: Path,
        *,
        options: XImu3DeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options = options or XImu3DeviceOptions()
        super().__init__(link, wire_noise, options.baud)
        self._inertial = InertialSignals(options.errors)
        self._codec = XImu3Codec()
        self.settings = _FACTORY | dict(options.settings)
        """Active settings."""
        self._pending = dict(self.settings)
        self._pushes = 0
        self._next_ns = {DataKind.MAGNETIC: 0, DataKind.BATTERY: 0}
        self._error = options.error
        self.saves = 0
        """Number of commands that saved the settings."""

    # --- control by the simulation ------------------------------------------------------------

    @property
    def streaming(self) -> bool:
        """Whether the interface sends measurements."""
        if self._options.interface == "USB":
            return bool(self.settings["usb_data_messages_enabled"])
        return self._alive and bool(self.settings["serial_data_messages_enabled"])

    @property
    def rate_hz(self) -> float:
        """Rate of the orientations, Hz, or of the raw measurements if there are no orientations."""
        for key in ("ahrs_message_rate_divisor", "inertial_message_rate_divisor"):
            if divisor := self._number(key):
                return BASE_RATE_HZ / divisor
        return 0.0

    @property
    def counter(self) -> int:
        """Number of the next sample. The device does not send this number."""
        return self._pushes

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return len(self._ahrs_message(0, (1.0, 0.0, 0.0, 0.0)))

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send the messages of one sample now, as described in `ImuDevice.push`."""
        self._last_ns = device_ns
        self._inertial.update(device_ns, q_world_sensor)
        if not self.streaming:
            return
        number, self._pushes = self._pushes, self._pushes + 1
        if self._to_lose:
            self._to_lose -= 1
            return

        ticks = self._ticks(device_ns)
        if self._error:
            self._write(
                encode_text(DataKind.ERROR, ticks, self._error.encode(), binary=self._binary)
            )
            self._error = ""
        self._push_slow_messages(device_ns, ticks)

        ahrs, inertial = map(
            self._number, ("ahrs_message_rate_divisor", "inertial_message_rate_divisor")
        )
        sent = True
        if inertial and number % max(round(inertial / (ahrs or inertial)), 1) == 0:
            sent = self._write(self._data(DataKind.INERTIAL, ticks, self._inertial_values()))
        if ahrs:
            sent = self._write(self._ahrs_message(ticks, q_world_sensor))
        self.sent += sent

    @override
    def edge(self, device_ns: int, *, rising: bool = True) -> None:
        """Send the message about an edge at the sync input, if the accessory is active."""
        if self.streaming and self.settings["serial_mode"] == _ACCESSORY:
            self._write(self._data(DataKind.SYNC, self._ticks(device_ns), (float(rising),)))

    def power_cycle(self) -> None:
        """Interrupt the power supply: the clock restarts."""
        self._epoch_ns, self._next_ns = self._last_ns, dict.fromkeys(self._next_ns, 0)

    # --- commands of the host -----------------------------------------------------------------

    @property
    def _alive(self) -> bool:
        return self._options.interface == "USB" or self.settings["serial_mode"] == 1

    @override
    def _receive(self, data: bytes) -> None:
        for command in self._codec.feed(data):
            if isinstance(command, XImu3Reply) and self._alive and self._options.answers:
                self._write(encode_command(command.key, self._reply(command.key, command.value)))

    def _reply(self, key: str, value: object) -> object:
        """Return the value of the answer to a command."""
        if key == "ping":
            names = {"name": "device_name", "sn": "serial_number"}
            found = {name: self.settings[stored] for name, stored in names.items()}
            return {"interface": self._options.interface} | found

        if key in _ACTIONS:
            if key == "apply":
                self.settings = dict(self._pending)
            self.saves += key == "save"
            return None

        # A written value becomes active at the next command `apply`.
        if key not in self._pending or key in self._options.missing:
            return {"error": "Unknown command"}
        if value is not None:
            fault = _fault(key, value, self._pending[key])
            if fault:
                return {"error": fault}
            self._pending[key] = value
        return self._pending[key]

    # --- messages to the host -----------------------------------------------------------------

    @property
    def _binary(self) -> bool:
        return bool(self.settings["binary_mode_enabled"])

    def _number(self, key: str) -> int:
        value = self.settings[key]
        return value if isinstance(value, int) else 0

    def _ticks(self, device_ns: int) -> int:
        return self._options.first_tick + (device_ns - self._epoch_ns) // TICK_NS

    def _data(self, kind: DataKind, ticks: int, values: tuple[float, ...]) -> bytes:
        return encode_data(kind, ticks, values, binary=self._binary)

    def _push_slow_messages(self, device_ns: int, ticks: int) -> None:
        """Send the magnetometer and battery messages if they are due."""
        divisor = self._number("magnetometer_message_rate_divisor")
        x, y, z = self._inertial.value(Item.MAGNETIC_FIELD) or (0.0, 0.0, 0.0)
        due = {
            DataKind.MAGNETIC: (_MAGNETIC_NS * divisor, (x, y, z)),
            DataKind.BATTERY: (_BATTERY_NS, (self._options.battery_percent, 3.9, 0.0)),
        }
        for kind, (interval_ns, values) in due.items():
            if interval_ns and device_ns - self._epoch_ns >= self._next_ns[kind]:
                self._next_ns[kind] = device_ns - self._epoch_ns + interval_ns
                self._write(self._data(kind, ticks, values))

    def _inertial_values(self) -> tuple[float, ...]:
        """Return the angular rate, deg/s, and the specific force, in units of gravity."""
        rate = self._inertial.value(Item.RATE_OF_TURN) or (0.0, 0.0, 0.0)
        force = self._inertial.value(Item.ACCELERATION) or (0.0, 0.0, 0.0)
        return (*map(degrees, rate), *(value / STANDARD_GRAVITY for value in force))

    def _ahrs_message(self, ticks: int, q_world_sensor: Quaternion) -> bytes:
        """Return the message of the orientation in the configured form."""
        world = _WORLDS[self._number("ahrs_axes_convention")]
        q = native_of(q_world_sensor, world)
        encode: tuple[Callable[[], bytes], ...] = (
            lambda: self._data(DataKind.QUATERNION, ticks, tuple(NORM * part for part in q)),
            lambda: self._data(DataKind.MATRIX, ticks, tuple(chain(*rotation_rows(q)))),
            lambda: self._data(DataKind.EULER, ticks, roll_pitch_yaw_deg(q)),
            lambda: self._data(DataKind.LINEAR_ACCELERATION, ticks, (0.0, 0.0, 0.0)),
            lambda: self._data(DataKind.EARTH_ACCELERATION, ticks, (0.0, 0.0, 0.0)),
        )
        return encode[self._number("ahrs_message_type")]()


def _fault(key: str, value: object, before: object) -> str:
    """Return the reason why a setting cannot have this value; empty if it can."""
    if key in _READ_ONLY:
        return "Read only"
    if isinstance(value, bool) != isinstance(before, bool) or type(value) is not type(before):
        return "Invalid type"
    if isinstance(value, int) and not 0 <= value <= _MOST.get(key, 1):
        return "Out of range"
    return ""
