"""Virtual LP-Research LPMS sensor of both generations, with LP-BUS on a pseudo-terminal (pty).

Invariant: each generation executes its own commands only. If the host sends a command of the other
generation, the sensor executes its own command with the same number. For example, 04 writes the
flash of generation 3, and 05 restores its factory settings. 08 puts generation 1 to sleep, and 16
starts its gyroscope calibration. Settings are lost at power-off unless they are stored.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.lpms import LpBusCodec, LpBusMessage, encode
from jointfit_protocols.lpms.configuration import (
    TABLES,
    Generation,
    LpmsCommand,
    LpmsConfiguration,
    decode_set,
    encode_configuration,
    encode_firmware,
)
from jointfit_protocols.lpms.measurement import TICK_MODULUS, PacketLayout, tick_of
from jointfit_protocols.orientation import native_of
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_protocols.orientation import World
    from jointfit_simulators.imu_device import Quaternion, WireNoise

_STATUS, _SLEEP, _GYRO_CALIBRATION = 0x05, 0x08, 0x16
"""Commands of generation 1 whose numbers are other commands in generation 3."""
_FACTORY = {
    1: LpmsConfiguration(TABLES[1].mask("accelerometer_raw", "euler", "quaternion"), 100, True),
    3: LpmsConfiguration(TABLES[3].mask("accelerometer", "euler", "quaternion"), 100, True),
}


@dataclass(frozen=True, slots=True)
class LpmsDeviceOptions:
    """Model, settings and faults of a sensor."""

    generation: Generation = 3
    sensor_id: int = 1
    name: str = "LPMS-CU2"
    """Device name, which generation 1 sends in reply to the command 5B."""
    firmware: str = "2.0.6"
    configuration: LpmsConfiguration | None = None
    """Settings that are initially in flash; the default is the factory settings."""
    world: World = "NWU"
    world_to_sensor: bool = True
    unit: int = 10_000
    """Number of counts for 1.0 in 16-bit data. Old firmware sends thousandths."""
    tick_hz: int | None = None
    """Tick rate of the time stamps, Hz; the default is the usual rate of the generation."""
    sends_seconds: bool = False
    """Whether time stamps are float32 seconds, as in generation 1 up to firmware 1.3.4."""
    first_tick: int = 0
    acknowledges: bool = True
    """Whether commands are acknowledged. Old firmware does not acknowledge them."""
    identifies: bool = True
    """Whether the sensor answers the command 5B."""
    streams_at_once: bool = True
    """Whether the sensor streams from the start."""
    text: bool = False
    """Whether the sensor sends lines of text instead of data packets."""
    baud: int | None = None
    """Line speed of the sensor, bit/s. At another speed, both sides receive invalid bytes. None
    accepts any speed (USB)."""
    words: bool = False
    """Whether checksums are sums of 16-bit words. They differ from sums of bytes only for sensor
    ids above 255."""
    refused_rates: tuple[int, ...] = field(default=())
    """Rates that the firmware does not support, Hz."""


class LpmsDevice(SerialDevice):
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

    def __init__(
        self,
        link: Path,
        *,
        options: LpmsDeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options = options or LpmsDeviceOptions()
        self._table = TABLES[options.generation]
        super().__init__(link, wire_noise, options.baud)
        self._decoder = LpBusCodec()

        self.flash = options.configuration or _FACTORY[options.generation]
        """Settings that remain after a loss of power."""
        self.configuration = self.flash
        """Active settings."""
        self.streaming = options.streams_at_once
        """Whether the sensor is in stream mode."""
        self.asleep = False

        self.counter = 0
        """Number of samples since power-up. The sensor does not send this number."""
        self.flash_writes = 0
        self.factory_resets = 0
        self.gyro_calibrations = 0
        self.commands: list[int] = []
        """Received commands in the order of arrival."""

    # --- control by the simulation ------------------------------------------------------------

    @property
    def rate_hz(self) -> float:
        """Configured sample rate, Hz."""
        return float(self.configuration.rate_hz or 0)

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return len(encode(LpmsCommand.DATA, self._packet(0, (1.0, 0.0, 0.0, 0.0))))

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now in stream mode, as described in `ImuDevice.push`."""
        self._last_ns = device_ns
        if not self.streaming or self.asleep:
            return
        self.counter += 1
        if self._to_lose:
            self._to_lose -= 1
            return
        if self._options.text:
            values = ",".join(f"{value:.4f}" for value in q_world_sensor)
            self.sent += self._write(f"{self._tick(device_ns)},{values}\r\n".encode())
            return
        data = self._packet(device_ns, q_world_sensor)
        self.sent += self._send(LpmsCommand.DATA, data)

    def power_cycle(self) -> None:
        """Interrupt the power supply; the time restarts, and the settings from flash apply."""
        self._epoch_ns, self.counter = self._last_ns, 0
        self.configuration, self.asleep = self.flash, False
        self.streaming = self._options.streams_at_once

    # --- commands of the host -----------------------------------------------------------------

    @override
    def _receive(self, data: bytes) -> None:
        for event in self._decoder.feed(data):
            is_mine = isinstance(event, LpBusMessage) and event.sensor_id == self._options.sensor_id
            if isinstance(event, LpBusMessage) and is_mine and not self.asleep:
                self.commands.append(event.command)
                self._execute(event.command, event.data)

    def _execute(self, command: int, data: bytes) -> None:
        if command == LpmsCommand.COMMAND_MODE:
            self.streaming = False
            self._acknowledge()
        elif self.streaming:
            return  # outside of command mode, other commands are ignored
        elif command == LpmsCommand.STREAM_MODE:
            self._acknowledge()
            self.streaming = True
        elif (reply := self._read(command)) is not None:
            self._send(command, reply)
        elif self._write_setting(command, data) or self._harm(command):
            self._acknowledge()
        else:
            self._acknowledge(accepted=False)

    def _read(self, command: int) -> bytes | None:
        """Return the reply to a read command; None for other commands."""
        options, table = self._options, self._table
        if command in table.reads:
            return encode_configuration(table, command, self.configuration)
        if command == table.read_firmware:
            return encode_firmware(table, options.firmware)
        if command == LpmsCommand.IDENTIFY and options.identifies:
            text = options.name.encode("ascii").ljust(16, b"\0")
            return text if table.generation == 1 else (2).to_bytes(4, "little")
        if command == LpmsCommand.DATA:
            return self._packet(self._last_ns, (1.0, 0.0, 0.0, 0.0))
        return bytes(4) if command == _STATUS and table.generation == 1 else None

    def _write_setting(self, command: int, data: bytes) -> bool:
        """Execute a set command; return whether the command and its value are valid."""
        part = decode_set(self._table, command, data)
        if part is None or part.rate_hz in self._options.refused_rates:
            return False
        if part.rate_hz is not None and part.rate_hz not in self._table.rates_hz:
            return False
        self.configuration = self.configuration.merge(part)
        return True

    def _harm(self, command: int) -> bool:
        """Execute a command with lasting effects; return False for other commands."""
        if command == self._table.store:
            self.flash = self.configuration
            self.flash_writes += 1
        elif command == self._table.factory_reset:
            self.configuration = self.flash = _FACTORY[self._options.generation]
            self.factory_resets += 1
            self.flash_writes += 1
        # Sleep and gyroscope calibration exist in generation 1 only.
        elif command == _SLEEP and self._options.generation == 1:
            self.asleep = True
        elif command == _GYRO_CALIBRATION and self._options.generation == 1:
            self.gyro_calibrations += 1
        else:
            return False
        return True

    # --- messages to the host -----------------------------------------------------------------

    def _acknowledge(self, *, accepted: bool = True) -> None:
        if self._options.acknowledges:
            self._send(LpmsCommand.ACK if accepted else LpmsCommand.NACK)

    def _send(self, command: int, data: bytes = b"") -> bool:
        options = self._options
        wire = encode(command, data, options.sensor_id)
        if options.words:
            lrc = (options.sensor_id + command + len(data) + sum(data)) & 0xFFFF
            wire = wire[:-4] + lrc.to_bytes(2, "little") + wire[-2:]
        return self._write(wire)

    def _tick(self, device_ns: int) -> int:
        hz = self._options.tick_hz or self._table.tick_hz
        # A tick is the number of a filter sample. Rounding removes the jitter of the clock.
        ticks = self._options.first_tick + round((device_ns - self._epoch_ns) * hz / NS_PER_S)
        return tick_of(ticks / hz) if self._options.sends_seconds else ticks % TICK_MODULUS

    def _packet(self, device_ns: int, q: Quaternion) -> bytes:
        """Return the data of one packet; outputs that are not simulated have the value 0."""
        options, (mask, _, floats) = self._options, self.configuration
        layout = PacketLayout(self._table, mask or 0)
        values = [0.0] * layout.values
        if "quaternion" in layout.places:
            w, x, y, z = native_of(q, options.world)
            sign = -1.0 if options.world_to_sensor else 1.0
            native = (w, sign * x, sign * y, sign * z)
            unit = 1 if floats else options.unit
            values[layout.places["quaternion"]] = [part * unit for part in native]
        return layout.encode(self._tick(device_ns), values, floats=bool(floats))
