"""Virtual device whose messages a table describes, on a serial line or a CAN bus.

The device sends orientations, and the inertial signals that follow from the orientations. It
encodes them with the codecs of the decoder. It never answers. Its faults are typical for custom
boards: text at power-up, messages of other types, samples marked as invalid, and a clock that
restarts at 0.

Invariant: clock and counter continue while the host does not receive.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from jointfit_protocols.can import CanFrame, frame_bits
from jointfit_protocols.orientation import World, native_of
from jointfit_protocols.table import (
    SLOTS,
    CanTable,
    FrameFormat,
    LineFormat,
    TableField,
    encode_can_frames,
    encode_frame,
    encode_line,
)
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.imu_device import clean_wire
from jointfit_simulators.wires import PtyLine

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_simulators.devices._sensor_errors import SensorErrors
    from jointfit_simulators.imu_device import Quaternion, WireNoise
    from jointfit_simulators.wires import CanWire

_BITS = 10
"""Number of bits per byte on a serial line (8N1)."""
_SIGNALS = {
    "rate": Item.RATE_OF_TURN,
    "acceleration": Item.ACCELERATION,
    "magnetic": Item.MAGNETIC_FIELD,
}


class TablePort(Protocol):
    """Wire of a device, which converts records to bytes or frames."""

    @property
    def is_open(self) -> bool:
        """Whether the host receives, as far as the wire can detect it."""

    @property
    def line_ns(self) -> int:
        """Transmission time of a sample, ns."""

    def send(self, values: Sequence[float]) -> bool:
        """Send a record; return whether the whole record was sent."""

    def send_text(self, text: bytes) -> None:
        """Send bytes that do not form a record; CAN ignores this call."""

    def unplug(self) -> None:
        """Disconnect the wire."""

    def plug(self) -> None:
        """Connect the wire."""

    async def run(self) -> None:
        """Run the wire until cancelled."""


class SerialTablePort:
    """Serial line on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    wire
        Description of the binary frames or text lines.
    wire_noise
        Noise applied to each message.
    """

    def __init__(
        self, link: Path, wire: FrameFormat | LineFormat, wire_noise: WireNoise = clean_wire
    ) -> None:
        self._line, self._wire, self._noise = PtyLine(link), wire, wire_noise
        self._size = 0
        self.is_open = True
        """Always True, because a serial device sends even if the host does not receive."""

    @property
    def line_ns(self) -> int:
        """Transmission time of the last message at the speed of the host's port, ns."""
        baud = self._line.host_baud
        return self._size * _BITS * 1_000_000_000 // baud if baud else 0

    def send(self, values: Sequence[float]) -> bool:
        """Send a record; return whether the whole record was sent."""
        wire = self._wire
        if isinstance(wire, LineFormat):
            data = encode_line(wire, values)
        else:
            data = encode_frame(wire, values)
        self._size = len(data)
        return self._line.write(self._noise(data))

    def send_text(self, text: bytes) -> None:
        """Send bytes that do not form a record."""
        if text:
            self._line.write(self._noise(text))

    def unplug(self) -> None:
        """Disconnect the line."""
        self._line.unplug()

    def plug(self) -> None:
        """Connect the line."""
        self._line.plug()

    async def run(self) -> None:
        """Run the line until cancelled; ignore received bytes."""
        await self._line.serve(lambda _: None)


class CanTablePort:
    """Frames on a CAN wire.

    Parameters
    ----------
    wire
        CAN bus, which several devices may share.
    table
        Description of the frames.
    """

    def __init__(self, wire: CanWire, table: CanTable) -> None:
        self.wire, self._table = wire, table

    @property
    def is_open(self) -> bool:
        """Whether the bus is open."""
        return self.wire.is_open

    @property
    def line_ns(self) -> int:
        """Transmission time of the frames of a sample, ns."""
        bitrate = self.wire.bitrate
        bits = sum(frame_bits(8, extended) for _, extended in self._table.keys)
        return bits * 1_000_000_000 // bitrate if bitrate else 0

    def send(self, values: Sequence[float]) -> bool:
        """Send the frames of a record; return whether all were sent."""
        return self.wire.is_open and self.wire.send(self.frames(values))

    def frames(self, values: Sequence[float]) -> list[CanFrame]:
        """Return the frames of a record."""
        return [
            CanFrame(0, number, data, extended)
            for (number, extended), data in encode_can_frames(self._table, values)
        ]

    def send_text(self, text: bytes) -> None:
        """Ignore the text, because a CAN bus transfers frames only."""

    def unplug(self) -> None:
        """Disconnect the wire."""
        self.wire.unplug()

    def plug(self) -> None:
        """Connect the wire."""
        self.wire.plug()

    async def run(self) -> None:
        """Run the wire until cancelled."""
        await self.wire.run()


@dataclass(frozen=True, slots=True)
class TableDeviceOptions:
    """Content of the records, and faults."""

    fields: Mapping[int, TableField] = field(default_factory=dict)
    """Format and SI scale of each number of a record, by slot (see `jointfit_protocols.table`). The
    position of a field matters in CAN frames and binary frames only."""
    rate_hz: float = 100.0
    world: World = "ENU"
    world_to_sensor: bool = False
    counts: int = 1 << 32
    """Modulus of time and counter in text lines."""
    valid: int = 1
    """Value of the validity field in valid samples."""
    invalid: int = 0
    """Number of samples after power-up that are marked as invalid."""
    greeting: bytes = b""
    """Bytes sent before the first sample after power-up, such as a text."""
    other: bytes = b""
    """Message of another type, sent before every tenth sample."""
    first_ns: int = 0
    """Clock value at power-up, ns."""
    first_counter: int = 0
    errors: SensorErrors | None = None
    """Errors of the device's sensors; None for exact measurements."""


class TableDevice:
    """`ImuDevice` whose messages a table describes.

    Parameters
    ----------
    port
        Wire of the device.
    options
        Content of the records, and faults.
    """

    def __init__(self, port: TablePort, options: TableDeviceOptions) -> None:
        self._port, self._options = port, options
        self._inertial = InertialSignals(options.errors)
        self.rate_hz = options.rate_hz
        """Configured sample rate, Hz."""
        self.counter = options.first_counter
        """Number of the next sample."""
        self._epoch_ns = self._last_ns = self._to_lose = self._since_start = 0
        self.sent = 0
        """Number of samples that were written to the wire."""

    @property
    def streaming(self) -> bool:
        """Whether the device sends. On a serial line it always sends, on CAN if the bus is open."""
        return self._port.is_open

    @property
    def line_ns(self) -> int:
        """Transmission time of a sample, ns."""
        return self._port.line_ns

    def edge(self, device_ns: int) -> None:
        """Ignore an edge on a sync input, because tables describe no sync messages."""

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now, as described in `ImuDevice.push`."""
        self._last_ns = device_ns
        self._inertial.update(device_ns, q_world_sensor)
        values = self.record(device_ns, q_world_sensor)
        self.counter += 1
        if self._since_start == 0:
            self._port.send_text(self._options.greeting)
        elif self._since_start % 10 == 0:
            self._port.send_text(self._options.other)
        self._since_start += 1
        if self._to_lose:
            self._to_lose -= 1
        elif self._port.send(values):
            self.sent += 1

    def record(self, device_ns: int, q_world_sensor: Quaternion) -> list[float]:
        """Return the transmitted numbers of a sample, in the order of their slots."""
        options = self._options
        w, x, y, z = native_of(q_world_sensor, options.world)
        native = (w, -x, -y, -z) if options.world_to_sensor else (w, x, y, z)
        time_s = (options.first_ns + device_ns - self._epoch_ns) * 1e-9
        valid = options.valid if self._since_start >= options.invalid else 0

        content: dict[str, Sequence[float]] = {
            "quaternion": native,
            "time": (time_s,),
            "counter": (self.counter,),
            "valid": (valid,),
        }
        content |= {name: self._inertial.value(item) or () for name, item in _SIGNALS.items()}

        return [
            self._number(options.fields[slot], float(content[name][slot - slots.start]), name)
            for name, slots in SLOTS.items()
            for slot in slots
            if slot in options.fields
        ]

    def _number(self, place: TableField, value: float, name: str) -> float:
        """Return the transmitted number for a value."""
        raw = (value - place.zero) / place.scale
        if place.kind == "f":
            return raw
        count = round(raw)
        if name in {"time", "counter"}:
            return count % min(place.modulus, self._options.counts)
        low = -(place.modulus // 2) if place.kind == "i" else 0
        return max(low, min(low + place.modulus - 1, count))

    def lose(self, count: int) -> None:
        """Lose the next `count` samples; the counter increments, but they are not sent."""
        self._to_lose += count

    def power_cycle(self) -> None:
        """Interrupt the power supply: clock and counter restart."""
        self._epoch_ns, self.counter = self._last_ns, self._options.first_counter
        self._since_start = 0

    def unplug(self) -> None:
        """Disconnect the wire."""
        self._port.unplug()

    def plug(self) -> None:
        """Connect the wire; the device remained powered."""
        self._port.plug()

    async def run(self) -> None:
        """Run the device until cancelled."""
        await self._port.run()
