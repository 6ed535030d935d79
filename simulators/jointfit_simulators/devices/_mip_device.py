"""Virtual MicroStrain device, which sends MIP messages on a pseudo-terminal (pty).

Invariants (as in real devices): settings are volatile until they are saved. A device of the current
family refuses commands of the legacy family, and vice versa. Every field has its own decimation, so
some packets contain no time. The output of the filter is later than the output of the sensor. A
changed line speed takes effect after 250 ms without data.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_protocols.mip import MipCodec, MipPacket, commands, encode
from jointfit_protocols.mip.commands import (
    Base,
    CommandSet,
    DeviceInformation,
    FilterSetup,
    FormatEntry,
    Function,
    Setup,
)
from jointfit_protocols.mip.data import (
    STANDARD_GRAVITY,
    DataSet,
    FilterField,
    SensorField,
    SharedField,
    encode_field,
    field_bytes,
)
from jointfit_protocols.orientation import native_of
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_protocols.mip import MipField
    from jointfit_protocols.mip.commands import Family
    from jointfit_simulators.imu_device import Quaternion, WireNoise

_FRAME_BYTES = 6
"""Number of bytes of a packet in addition to its fields."""
_SPEED_BYTES = 4
"""Number of bytes of a line speed in a command."""
_SPEED_CHANGE_S = 0.25
"""Time without data before a changed line speed takes effect, s."""
_INVALID, _FAILED = 3, 4
"""Reply codes: invalid parameter, and command failed."""
_FIELDS: dict[int, tuple[int, ...]] = {
    DataSet.SENSOR: (0x04, 0x05, 0x06, 0x0A, 0x0C, 0x12, *SharedField),
    DataSet.FILTER: (0x03, 0x05, 0x10, 0x11, *SharedField),
}
_COMMANDS: dict[str, tuple[int, ...]] = {
    "current": (Setup.BASE_RATE, Setup.FORMAT, Setup.TRANSFORM),
    "legacy": (
        Setup.IMU_BASE_RATE,
        Setup.FILTER_BASE_RATE,
        Setup.IMU_FORMAT,
        Setup.FILTER_FORMAT,
    ),
}


_CV7 = DeviceInformation(1105, "3DM-CV7-AHRS", "6286-9910", "6286.00042", "I03A", "5g, 500dps")


@dataclass(frozen=True, slots=True)
class MipDeviceOptions:
    """Model, settings and faults of a device."""

    info: DeviceInformation = _CV7
    family: Family = "current"
    base_rates_hz: tuple[tuple[int, int], ...] = ((DataSet.SENSOR, 1000), (DataSet.FILTER, 500))
    """Data sets of the device, each with its base rate, Hz."""
    formats: tuple[tuple[int, tuple[tuple[int, int], ...]], ...] = ()
    """Saved message formats: data set, and its fields with their decimations."""
    streams: tuple[int, ...] = ()
    """Data sets whose stream is on in the saved settings."""
    missing_fields: tuple[tuple[int, int], ...] = ()
    """Measurements that this model lacks: data set and field."""
    names_descriptors: bool = True
    """Whether the device answers the request for its descriptors."""
    transform: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Saved sensor-to-vehicle rotation of a device of the current family."""
    roll_rad: float = 0.0
    """Saved sensor-to-vehicle rotation angle of a legacy device about x, rad."""
    baud: int | None = None
    """Line speed of the device, bit/s. At another speed, both sides receive invalid bytes. None
    accepts any speed (USB)."""
    invalid_samples: int = 0
    """Number of filter orientations after power-up that are marked as invalid."""
    filter_delay: int = 1
    """Delay of the filter's output relative to the sensor's output if both are streamed, samples.
    """
    idle_delay_s: float = 0.0
    """Time until the device acknowledges the idle command, s. Until then, it streams."""
    first_ns: int = 0
    """Clock at power-up, ns."""


@dataclass
class _StreamState:
    """Volatile settings of one data set."""

    outputs: tuple[FormatEntry, ...] = ()
    is_on: bool = False
    count: int = 0
    """Number of samples since power-up or the last change of the message format."""
    delayed: list[tuple[int, Quaternion]] = field(default_factory=list)
    """Samples that are not yet sent, each with time and orientation."""


class MipDevice(SerialDevice):
    """`ImuDevice` on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    options
        Model, settings and faults.
    wire_noise
        Noise applied to each packet to the host.
    """

    garbage_bits = 0x3F

    def __init__(
        self,
        link: Path,
        *,
        options: MipDeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options = options or MipDeviceOptions()
        super().__init__(link, wire_noise, options.baud)
        self._codec = MipCodec()
        self._inertial = InertialSignals()

        # Saved outputs of each data set, and whether its stream is on.
        self._base_rates = dict(options.base_rates_hz)
        self._saved = {
            data_set: (
                tuple(FormatEntry(*output) for output in dict(options.formats).get(data_set, ())),
                data_set in options.streams,
            )
            for data_set in self._base_rates
        }
        self._changing_speed = False

        self.writes = 0
        """Number of write commands for settings."""
        self.saves = 0
        """Number of commands that saved the settings."""
        self._power_up()

    def _power_up(self) -> None:
        self._streams = {
            data_set: _StreamState(outputs, is_on)
            for data_set, (outputs, is_on) in self._saved.items()
        }
        self.idle = False
        """Whether the device was set to idle."""
        self.counter = 0
        """Number of the next sample. The device does not send this number."""
        self._invalid_left = self._options.invalid_samples

    # --- control by the simulation ------------------------------------------------------------

    @property
    def streaming(self) -> bool:
        """Whether the device streams."""
        return not self.idle and any(one.is_on and one.outputs for one in self._streams.values())

    @property
    def rate_hz(self) -> float:
        """Rate of the first active stream, Hz; 0 without an active stream."""
        for data_set, state in self._streams.items():
            if state.is_on and state.outputs:
                return self._base_rates[data_set] / _fastest(state)
        return 0.0

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return sum(
            _FRAME_BYTES + sum(field_bytes(data_set, one.field) for one in state.outputs)
            for data_set, state in self._streams.items()
            if state.is_on
        )

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now while streaming, as described in `ImuDevice.push`."""
        self._last_ns = device_ns
        self._inertial.update(device_ns, q_world_sensor)
        if not self.streaming or self._changing_speed:
            return
        self.counter += 1
        if self._to_lose:
            self._to_lose -= 1
            return

        both = all(state.is_on for state in self._streams.values()) and len(self._streams) > 1
        complete = True
        for data_set, state in self._streams.items():
            if not state.is_on:
                continue
            state.delayed.append((device_ns, q_world_sensor))
            late = self._options.filter_delay if both and data_set == DataSet.FILTER else 0
            if len(state.delayed) <= late:
                continue
            at_ns, q = state.delayed.pop(0)
            fields = self._fields(data_set, state, at_ns, q)
            state.count += 1
            complete &= not fields or self._write(encode(data_set, fields))
        self.sent += complete

    def power_cycle(self) -> None:
        """Interrupt the power supply: the clock restarts, and saved settings apply."""
        self._epoch_ns = self._last_ns
        self._power_up()

    # --- commands of the host -----------------------------------------------------------------

    @override
    def _receive(self, data: bytes) -> None:
        if self._changing_speed:
            return
        for event in self._codec.feed(data):
            if isinstance(event, MipPacket):
                for command, content in event.fields:
                    self._answer(event.descriptor_set, command, content)

    def _answer(self, command_set: int, command: int, data: bytes) -> None:
        if (command_set, command) == (CommandSet.BASE, Base.IDLE) and not self.idle:
            if delay_s := self._options.idle_delay_s:
                accepted = (commands.REPLY, bytes((command, commands.OK)))

                def acknowledge() -> None:
                    self.idle = True
                    self._write(encode(CommandSet.BASE, (accepted,)))

                self._after(delay_s, acknowledge)
                return
            self.idle = True

        code, fields = self._reply(command_set, command, data)
        self._write(encode(command_set, ((commands.REPLY, bytes((command, code))), *fields)))

    def _reply(
        self, command_set: int, command: int, data: bytes
    ) -> tuple[int, tuple[MipField, ...]]:
        """Return the code and the fields of the reply to a command."""
        if command_set == CommandSet.BASE:
            return self._base_reply(command, data)
        if command_set == CommandSet.FILTER and command == FilterSetup.ROTATION:
            if self._options.family == "legacy" and data[:1] == bytes((Function.READ,)):
                angles = commands.encode_floats(self._options.roll_rad, 0.0, 0.0)
                return commands.OK, ((FilterSetup.ROTATION_REPLY, angles),)
        elif command_set == CommandSet.SETUP:
            return self._setup_reply(command, data)
        return commands.UNKNOWN_COMMAND, ()

    def _base_reply(self, command: int, data: bytes) -> tuple[int, tuple[MipField, ...]]:
        content: tuple[MipField, ...]
        match command:
            case Base.PING | Base.IDLE | Base.RESUME:
                self.idle &= command != Base.RESUME
                content = ()
            case Base.DEVICE_INFO:
                content = ((Base.DEVICE_INFO_REPLY, commands.encode_info(self._options.info)),)
            case Base.DESCRIPTORS if self._options.names_descriptors:
                names = commands.encode_descriptors(self._command_names())
                content = ((Base.DESCRIPTORS_REPLY, names),)
            case Base.MORE_DESCRIPTORS if self._options.names_descriptors:
                names = commands.encode_descriptors(self._field_names())
                content = ((Base.MORE_DESCRIPTORS_REPLY, names),)
            case Base.PORT_SPEED if self._options.family == "current":
                return self._speed_reply(data[:1], data[2:], data[1:2], Base.PORT_SPEED_REPLY)
            case _:
                return commands.UNKNOWN_COMMAND, ()
        return commands.OK, content

    def _command_names(self) -> list[int]:
        base = (Base.PING, Base.IDLE, Base.DEVICE_INFO, Base.DESCRIPTORS, Base.RESUME)
        setup = (Setup.STREAM, Setup.STARTUP_SETTINGS, *_COMMANDS[self._options.family])
        return [CommandSet.BASE << 8 | one for one in base] + [
            CommandSet.SETUP << 8 | one for one in setup
        ]

    def _field_names(self) -> list[int]:
        return [
            data_set << 8 | one
            for data_set in self._base_rates
            for one in _FIELDS[data_set]
            if (data_set, one) not in self._options.missing_fields
        ]

    def _setup_reply(self, command: int, data: bytes) -> tuple[int, tuple[MipField, ...]]:
        match command:
            case Setup.STREAM:
                return self._stream_reply(data)
            case Setup.STARTUP_SETTINGS if data == bytes((Function.SAVE,)):
                self._saved = {
                    data_set: (one.outputs, one.is_on) for data_set, one in self._streams.items()
                }
                self.saves += 1
                return commands.OK, ()
            case Setup.UART_BAUD if self._options.family == "legacy":
                return self._speed_reply(data[:1], data[1:], b"", Setup.UART_BAUD_REPLY)
            case Setup.TRANSFORM if self._options.family == "current":
                turn = commands.encode_floats(*self._options.transform)
                return commands.OK, ((Setup.TRANSFORM_REPLY, turn),)
        return self._output_reply(command, data)

    def _output_reply(self, command: int, data: bytes) -> tuple[int, tuple[MipField, ...]]:
        """Return code and fields of the reply to a command about base rate or message format."""
        for data_set in self._base_rates:
            stream = commands.stream_commands(self._options.family, data_set)
            if command == stream.base_rate and data == stream.prefix:
                rate = commands.encode_rate(stream.prefix, self._base_rates[data_set])
                return commands.OK, ((stream.base_rate_reply, rate),)
            if command == stream.format and data[1:].startswith(stream.prefix):
                return self._format_reply(data_set, stream, data)
        known = command in _COMMANDS[self._options.family]
        return (_INVALID if known else commands.UNKNOWN_COMMAND), ()

    def _format_reply(
        self, data_set: int, stream: commands.StreamCommands, data: bytes
    ) -> tuple[int, tuple[MipField, ...]]:
        state = self._streams[data_set]
        if data[0] == Function.READ:
            found = commands.encode_outputs(stream.prefix, state.outputs)
            return commands.OK, ((stream.format_reply, found),)

        outputs = commands.decode_outputs(stream.prefix, data[1:])
        names = self._field_names()
        if data[0] != Function.WRITE or outputs is None:
            return _INVALID, ()
        if any(data_set << 8 | one.field not in names or not one.decimation for one in outputs):
            return _INVALID, ()
        self._streams[data_set] = _StreamState(outputs, state.is_on)
        self.writes += 1
        return commands.OK, ()

    def _stream_reply(self, data: bytes) -> tuple[int, tuple[MipField, ...]]:
        family = self._options.family
        for data_set, state in self._streams.items():
            selector = commands.stream_commands(family, data_set).selector
            if data[1:2] != bytes((selector,)):
                continue
            if data[0] == Function.READ:
                return commands.OK, ((Setup.STREAM_REPLY, bytes((selector, state.is_on))),)
            if data[0] == Function.WRITE and data[2:]:
                state.is_on = bool(data[2])
                self.writes += 1
                return commands.OK, ()
        return _INVALID, ()

    def _speed_reply(
        self, function: bytes, speed: bytes, port: bytes, reply: int
    ) -> tuple[int, tuple[MipField, ...]]:
        if function == bytes((Function.READ,)):
            return commands.OK, ((reply, port + (self.baud or 115_200).to_bytes(4, "big")),)
        if function != bytes((Function.WRITE,)) or len(speed) != _SPEED_BYTES:
            return _INVALID, ()

        def change() -> None:
            self.baud, self._changing_speed = int.from_bytes(speed, "big"), False

        def stop() -> None:  # runs after the acknowledgement
            self._changing_speed = True
            self._after(_SPEED_CHANGE_S, change)

        asyncio.get_running_loop().call_soon(stop)
        return commands.OK, ()

    # --- packets to the host ------------------------------------------------------------------

    def _fields(
        self, data_set: int, state: _StreamState, device_ns: int, q: Quaternion
    ) -> tuple[MipField, ...]:
        """Return the fields of one packet; each field has its own decimation."""
        fastest = _fastest(state)
        return tuple(
            encode_field(data_set, one.field, *self._values(data_set, one.field, device_ns, q))
            for one in state.outputs
            if state.count * fastest % one.decimation == 0
        )

    def _values(
        self, data_set: int, descriptor: int, device_ns: int, q: Quaternion
    ) -> tuple[float, ...]:
        """Return the values of a field."""
        t_ns = self._options.first_ns + device_ns - self._epoch_ns
        if (data_set, descriptor) == (DataSet.FILTER, FilterField.QUATERNION):
            valid = self._invalid_left == 0
            self._invalid_left -= not valid
            return (*native_of(q, "NED"), valid)

        # Without a pulse-per-second input, the GPS time is the time since the start.
        gps: tuple[float, ...] = (t_ns * 1e-9, 0, 0)
        x, y, z = (value / STANDARD_GRAVITY for value in self._inertial.force)
        known: dict[tuple[int, int], tuple[float, ...]] = {
            (data_set, SharedField.REFERENCE_TIME): (t_ns,),
            (DataSet.SENSOR, SensorField.GPS_TIME): gps,
            (DataSet.FILTER, FilterField.GPS_TIME): gps,
            (DataSet.SENSOR, SensorField.QUATERNION): native_of(q, "NED"),
            (DataSet.SENSOR, SensorField.ACCELERATION): (x, y, z),
            (DataSet.SENSOR, SensorField.ANGULAR_RATE): self._inertial.rate,
            (DataSet.SENSOR, SensorField.MAGNETIC_FIELD): self._inertial.field,
        }
        return known.get((data_set, descriptor)) or _ZEROS.get((data_set, descriptor), (0,))


_ZEROS: dict[tuple[int, int], tuple[float, ...]] = {
    (DataSet.SENSOR, SensorField.EULER_ANGLES): (0.0,) * 3,
    (DataSet.FILTER, FilterField.EULER_ANGLES): (0.0, 0.0, 0.0, 1),
    (DataSet.FILTER, FilterField.STATUS): (3, 1, 0),
    (DataSet.SENSOR, SharedField.GPS_TIME): (0.0, 0, 0),
    (DataSet.FILTER, SharedField.GPS_TIME): (0.0, 0, 0),
    (DataSet.SENSOR, SharedField.EXTERNAL_TIME): (0, 0),
    (DataSet.FILTER, SharedField.EXTERNAL_TIME): (0, 0),
}
"""Zero values for fields that are not simulated, by data set and field."""


def _fastest(state: _StreamState) -> int:
    """Return the smallest decimation of a stream."""
    return min((one.decimation for one in state.outputs), default=1)
