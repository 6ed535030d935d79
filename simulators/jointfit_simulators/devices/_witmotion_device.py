"""Virtual WitMotion device on a pseudo-terminal (pty), with the faults of real devices.

Invariants: the device sends no quaternion until it is configured, and acknowledges no command. It
accepts write commands for 10 s after the unlock command. Written values are lost at power-off
unless they are saved.
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_protocols.orientation import native_of
from jointfit_protocols.witmotion import (
    BAUD_CODES,
    COMMAND_BYTES,
    FULL_SCALE,
    RATE_CODES,
    TICK_NS,
    WitMotionCommand,
    WitMotionFrameKind,
    WitMotionRegister,
    content_bits,
    decode_command,
    encode,
    encode_counts,
    encode_time,
)
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._rotations import roll_pitch_yaw_deg
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_protocols.orientation import World
    from jointfit_simulators.imu_device import Quaternion, WireNoise

UNLOCKED_S = 10.0
"""Time after the unlock command in which write commands are accepted, s."""
FACTORY_CONTENT = content_bits(
    WitMotionFrameKind.ACCELERATION,
    WitMotionFrameKind.RATE,
    WitMotionFrameKind.ANGLE,
    WitMotionFrameKind.MAGNETIC_FIELD,
)
"""Frames that a new device sends."""
WITH_QUATERNION = content_bits(WitMotionFrameKind.QUATERNION)
_UNLOCK = 0xB588
_FIRST_KIND = int(WitMotionFrameKind.TIME)
_KINDS = 16
_G = 9.8
_FULL_RATE = radians(2000.0)
_EPOCH_MS = 475_372_800_000
"""Clock value at power-up, ms since 2000. The date is arbitrary (24 January 2015)."""
_FIELD_COUNTS = 500
"""Magnitude of the magnetic field, counts."""
_GLITCH_MS = 3_600_000
_OTHER_FRAME = struct.Struct("<BB9h")


@dataclass(frozen=True, slots=True)
class WitMotionDeviceOptions:
    """Settings in flash, and faults of a device."""

    content: int = FACTORY_CONTENT
    """Value of the register CONTENT."""
    rate_hz: int = 10
    baud: int | None = None
    """Line speed of the device, bit/s. At another speed, both sides receive invalid bytes. None
    accepts any speed."""
    world: World = "ENU"
    world_to_sensor: bool = False
    answers_reads: bool = True
    """Whether the firmware answers read commands."""
    ignores_commands: bool = False
    """Whether the wire from the host to the device is broken."""
    bluetooth: bool = False
    """Whether the device sends frames that begin with 55 61, like Bluetooth models."""
    time_glitch_every: int = 0
    """Number of samples between two errors of the calendar time; 0 disables the errors."""


class WitMotionDevice(SerialDevice):
    """`ImuDevice` on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    options
        Settings and faults.
    wire_noise
        Noise applied to each sample to the host.
    now_s
        Clock that measures the time since the unlock command, s.
    """

    streaming = True  # the device always sends
    garbage_bits = 0x4A

    def __init__(
        self,
        link: Path,
        *,
        options: WitMotionDeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._options = options = options or WitMotionDeviceOptions()
        super().__init__(link, wire_noise)
        self._now_s = now_s
        self._inertial = InertialSignals()

        self.flash = {
            int(WitMotionRegister.CONTENT): options.content,
            int(WitMotionRegister.RATE): RATE_CODES[options.rate_hz],
        }
        if options.baud is not None:
            self.flash[WitMotionRegister.BAUD] = BAUD_CODES[options.baud]
        self.registers = dict(self.flash)
        """Active registers; `flash` contains the registers that remain after power-off."""
        self._unlocked_until_s = 0.0
        self._rest = b""

        self.counter = 0
        """Number of the next sample. The device does not send this number."""
        self.saved = 0
        """Number of commands that stored the registers in flash."""

    # --- control by the simulation ------------------------------------------------------------

    @property
    def rate_hz(self) -> float:
        """Configured sample rate, Hz."""
        codes = {code: rate for rate, code in RATE_CODES.items()}
        return float(codes.get(self.registers[WitMotionRegister.RATE], 10))

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return len(self._frames(0, (1.0, 0.0, 0.0, 0.0)))

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now, as described in `ImuDevice.push`."""
        self._inertial.update(device_ns, q_world_sensor)
        self.counter += 1
        if self._to_lose:
            self._to_lose -= 1
        elif self._options.bluetooth:
            self._write(self._other_frame(q_world_sensor))
        elif self._write(self._frames(device_ns, q_world_sensor)):
            self.sent += 1

    def power_cycle(self) -> None:
        """Interrupt the power supply: settings that were not saved are lost."""
        self.counter = 0
        self.registers = dict(self.flash)
        self._unlocked_until_s = 0.0

    # --- commands of the host -----------------------------------------------------------------

    @override
    def _receive(self, data: bytes) -> None:
        if self._options.ignores_commands or not self._same_speed:
            return
        self._rest += data
        while len(self._rest) >= COMMAND_BYTES:
            command = decode_command(self._rest[:COMMAND_BYTES])
            self._rest = self._rest[COMMAND_BYTES if command else 1 :]
            if command is not None:
                self._execute(command)

    def _execute(self, command: WitMotionCommand) -> None:
        register, value = command
        if register == WitMotionRegister.READ:
            if self._options.answers_reads:
                values = [self.registers.get(value + k, 0) for k in range(4)]
                data = struct.pack("<4H", *values)
                self._write(encode(WitMotionFrameKind.REGISTERS, data))
        elif register == WitMotionRegister.KEY:
            if value == _UNLOCK:
                self._unlocked_until_s = self._now_s() + UNLOCKED_S
        elif self._now_s() >= self._unlocked_until_s:
            return  # a write requires the unlock command
        elif register == WitMotionRegister.SAVE:
            self.flash = dict(self.registers)
            self.saved += 1
        else:
            self.registers[register] = value

    # --- frames to the host -------------------------------------------------------------------

    @property
    @override
    def _same_speed(self) -> bool:
        code = self.registers.get(WitMotionRegister.BAUD)
        host = self._line.host_baud
        return code is None or (host is not None and BAUD_CODES.get(host) == code)

    def _frames(self, device_ns: int, q: Quaternion) -> bytes:
        """Return the frames of one sample, in the order of their types."""
        content = self.registers[WitMotionRegister.CONTENT]
        kinds = [_FIRST_KIND + bit for bit in range(_KINDS) if content >> bit & 1]
        return b"".join(encode(kind, self._data(kind, device_ns, q)) for kind in kinds)

    def _data(self, kind: int, device_ns: int, q: Quaternion) -> bytes:
        if kind == WitMotionFrameKind.TIME:
            every = self._options.time_glitch_every
            glitch = every and self.counter % every == every - 1
            return encode_time(_EPOCH_MS + device_ns // TICK_NS + _GLITCH_MS * bool(glitch))
        # Missing values are 0.
        values = [*self._values(kind, q), 0.0, 0.0, 0.0, 0.0][:4]
        w, x, y, z = (round(value * FULL_SCALE) for value in values)
        return encode_counts((w, x, y, z))

    def _values(self, kind: int, q: Quaternion) -> list[float]:
        """Return the values of a frame as fractions of full scale; empty for other frame types."""
        match kind:
            case WitMotionFrameKind.ACCELERATION:
                return self._signal(Item.ACCELERATION, 16.0 * _G)
            case WitMotionFrameKind.RATE:
                return self._signal(Item.RATE_OF_TURN, _FULL_RATE)
            case WitMotionFrameKind.MAGNETIC_FIELD:
                return self._signal(Item.MAGNETIC_FIELD, FULL_SCALE / _FIELD_COUNTS)
            case WitMotionFrameKind.ANGLE:
                return [angle / 180.0 for angle in roll_pitch_yaw_deg(q)]
            case WitMotionFrameKind.QUATERNION:
                w, x, y, z = native_of(q, self._options.world)
                sign = -1.0 if self._options.world_to_sensor else 1.0
                return [w, sign * x, sign * y, sign * z]
            case _:
                return []

    def _signal(self, item: Item, full: float) -> list[float]:
        return [value / full for value in self._inertial.value(item) or ()]

    def _other_frame(self, q: Quaternion) -> bytes:
        """Return a frame of the variant 55 61: acceleration, rate, angle and no checksum."""
        angles = [round(angle / 180.0 * FULL_SCALE) for angle in roll_pitch_yaw_deg(q)]
        limited = [max(-FULL_SCALE, min(FULL_SCALE - 1, angle)) for angle in angles]
        return _OTHER_FRAME.pack(0x55, 0x61, 0, 0, 2048, 0, 0, 0, *limited)
