"""Virtual VectorNav device with binary outputs and ASCII registers on a pseudo-terminal (pty).

Invariants: registers are volatile until they are stored. The reply to a valid request repeats the
request, and the reply to an invalid request is an error message. ASCII messages are sent between
binary outputs. Asynchronous output can be paused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from typing_extensions import override

from jointfit_protocols.orientation import native_of
from jointfit_protocols.vectornav import (
    BinaryLayout,
    Field,
    TextMessage,
    VectorNavCodec,
    encode_binary,
    encode_text,
)
from jointfit_protocols.vectornav.registers import (
    BOTH_PORTS,
    BinaryOutput,
    Register,
    decode_output,
    encode_output,
)
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._rotations import roll_pitch_yaw_deg
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import Quaternion, WireNoise

_OUTPUTS = range(Register.BINARY_OUTPUT, Register.BINARY_OUTPUT + 3)
_INVALID_PARAMETER, _INVALID_REGISTER, _INVALID_COMMAND = 7, 8, 4
_IDENTITY = "1,0,0,0,1,0,0,0,1"
ORIENTATION = BinaryLayout((Field.TIME_STARTUP, Field.QUATERNION)).fields


@dataclass(frozen=True, slots=True)
class VectorNavDeviceOptions:
    """Model, settings and faults of a device."""

    model: str = "VN-100S-CR"
    serial: str = "0100012345"
    firmware: str = "3.1.0.0"
    imu_rate_hz: int = 800
    outputs: tuple[tuple[int, int, tuple[int, ...]], ...] = ()
    """Stored settings of the binary outputs 1, 2 and 3: ports, rate divisor, and fields."""
    text_output: str = "VNYMR"
    """Stored ASCII output; empty if it is off."""
    rotation: str = _IDENTITY
    """Reference frame rotation (register 26)."""
    missing_fields: tuple[int, ...] = ()
    """Binary output fields that this model refuses."""
    baud: int | None = None
    """Line speed of the device, bit/s. At another speed, both sides receive invalid bytes. None
    accepts any speed (USB)."""
    first_ns: int = 0
    """Clock at power-up, ns."""


class VectorNavDevice(SerialDevice):
    """`ImuDevice` on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    options
        Model, settings and faults.
    wire_noise
        Noise applied to each message to the host.
    """

    garbage_bits = 0x1F

    def __init__(
        self,
        link: Path,
        *,
        options: VectorNavDeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options = options or VectorNavDeviceOptions()
        super().__init__(link, wire_noise, options.baud)
        self._codec = VectorNavCodec()
        self._inertial = InertialSignals()

        # Registers in flash.
        self._stored_outputs = dict(
            zip(_OUTPUTS, (BinaryOutput(*one) for one in options.outputs), strict=False)
        )
        self._stored_text = options.text_output
        self._q: Quaternion = (1.0, 0.0, 0.0, 0.0)

        self.writes = 0
        """Number of register writes."""
        self.stores = 0
        """Number of commands that stored the registers."""
        self._power_up()

    def _power_up(self) -> None:
        none = BinaryOutput(0, 1, ())
        self.outputs = {number: self._stored_outputs.get(number, none) for number in _OUTPUTS}
        """Current settings of the binary outputs, by register."""
        self.text_output = self._stored_text
        """Active ASCII output; empty if it is off."""
        self.paused = False
        """Whether asynchronous output is paused."""
        self.counter = 0
        """Number of the next sample. The device does not send this number."""

    # --- control by the simulation ------------------------------------------------------------

    @property
    def streaming(self) -> bool:
        """Whether the device sends binary outputs."""
        return not self.paused and any(one.ports and one.fields for one in self.outputs.values())

    @property
    def rate_hz(self) -> float:
        """Rate of the first active binary output, Hz; 0 without an active output."""
        for one in self.outputs.values():
            if one.ports and one.fields:
                return self._options.imu_rate_hz / one.divisor
        return 0.0

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return sum(
            len(self._output(one, 0, self._q))
            for one in self.outputs.values()
            if one.ports and one.fields
        )

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now while streaming, as described in `ImuDevice.push`."""
        self._last_ns, self._q = device_ns, q_world_sensor
        self._inertial.update(device_ns, q_world_sensor)
        if self.paused:
            return
        if self.text_output:
            roll, pitch, yaw = roll_pitch_yaw_deg(native_of(q_world_sensor, "NED"))
            self._write(
                encode_text(f"{self.text_output},{yaw:+08.3f},{pitch:+08.3f},{roll:+08.3f}")
            )
        if not self.streaming:
            return

        self.counter += 1
        if self._to_lose:
            self._to_lose -= 1
            return
        complete = True
        for one in self.outputs.values():
            if one.ports and one.fields:
                complete &= self._write(self._output(one, device_ns, q_world_sensor))
        self.sent += complete

    def power_cycle(self) -> None:
        """Interrupt the power supply: the clock restarts, and stored registers apply."""
        self._epoch_ns = self._last_ns
        self._power_up()

    # --- requests of the host -----------------------------------------------------------------

    @override
    def _receive(self, data: bytes) -> None:
        for event in self._codec.feed(data):
            if isinstance(event, TextMessage):
                self._write(encode_text(self._reply(event)))

    def _reply(self, message: TextMessage) -> str:
        """Return the reply to a request, or an error message."""
        # The reply repeats a valid command; the reply to a read adds the content.
        echo = ",".join((message.command, *message.values))
        match message.command:
            case "VNASY" if message.values in {("0",), ("1",)}:
                self.paused = message.values == ("0",)
            case "VNWNV":
                self._stored_outputs, self._stored_text = dict(self.outputs), self.text_output
                self.stores += 1
            case "VNRRG" if message.register is not None:
                content = self._read(message.register)
                if content is None:
                    return _error(_INVALID_REGISTER)
                echo = f"VNRRG,{message.register:02d},{content}"
            case "VNWRG" if message.register is not None:
                if not self._store_volatile(message.register, message.values[1:]):
                    return _error(_INVALID_PARAMETER)
                self.writes += 1
            case _:
                return _error(_INVALID_COMMAND)
        return echo

    def _read(self, register: int) -> str | None:
        """Return the content of a register; None if the register does not exist."""
        if register in self.outputs:
            output = self.outputs[register]
            return encode_output(output) if output.fields else f"{output.ports},{output.divisor},00"

        x, y, z = (f"{value:+.6f}" for value in native_of(self._q, "NED")[1:])
        options = self._options
        return {
            int(Register.MODEL): options.model,
            int(Register.SERIAL): options.serial,
            int(Register.FIRMWARE): options.firmware,
            int(Register.BAUD): str(options.baud or 115_200),
            int(Register.TEXT_OUTPUT): "14" if self.text_output else "0",
            int(Register.QUATERNION): f"{x},{y},{z},{native_of(self._q, 'NED')[0]:+.6f}",
            int(Register.ROTATION): options.rotation,
        }.get(register)

    def _store_volatile(self, register: int, values: tuple[str, ...]) -> bool:
        """Write a register; return whether the register and the values are valid."""
        if register == Register.TEXT_OUTPUT and values[:1] == ("0",):
            self.text_output = ""
            return True
        output = decode_output(values) if register in self.outputs else None
        if output is None or output.ports > BOTH_PORTS or output.divisor < 1:
            return False
        if set(output.fields) & set(self._options.missing_fields):
            return False
        self.outputs[register] = output
        return True

    # --- messages to the host -----------------------------------------------------------------

    def _output(self, output: BinaryOutput, device_ns: int, q: Quaternion) -> bytes:
        t_ns = self._options.first_ns + device_ns - self._epoch_ns
        w, x, y, z = native_of(q, "NED")
        known: dict[int, tuple[Any, ...]] = {
            Field.TIME_STARTUP: (t_ns,),
            Field.TIME_GROUP_STARTUP: (t_ns,),
            Field.QUATERNION: (x, y, z, w),
            Field.ATTITUDE_QUATERNION: (x, y, z, w),
            Field.ANGULAR_RATE: self._inertial.rate,
            Field.IMU_ANGULAR_RATE: self._inertial.rate,
            Field.ACCELERATION: self._inertial.force,
            Field.IMU_ACCELERATION: self._inertial.force,
            Field.IMU_MAGNETIC_FIELD: self._inertial.field,
            Field.MAGNETIC_AND_PRESSURE: (*self._inertial.field, 25.0, 101.3),
        }

        # All other fields contain zeros.
        places = BinaryLayout(output.fields).places
        return encode_binary(
            {
                field: known.get(field, (0,) * (place.stop - place.start))
                for field, place in places.items()
            }
        )


def _error(code: int) -> str:
    return f"VNERR,{code:02X}"
