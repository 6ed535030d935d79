"""Virtual Xsens / Movella device: Xbus on a pty, with the behaviour and faults of real devices.

Invariant: the device streams while GoToConfig is pending, rejects an invalid output configuration
with error 0x21, acknowledges with the rates in use, stores each setting in flash at once, and sends
WakeUp after power-up. Source: MT0101P rev. 2020.A.
"""

from __future__ import annotations

import asyncio
import random
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

from jointfit_protocols.orientation import native_of
from jointfit_protocols.xbus import MASTER, XbusCodec, XbusMessage, XbusMessageId, encode, mtdata2
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.xbus.sync_lines import IN1
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._xbus_sync_inputs import SyncInputs
from jointfit_simulators.imu_device import clean_wire
from jointfit_simulators.wires import PtyLine

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_protocols.xbus.mtdata2 import Trigger, Value
    from jointfit_simulators.imu_device import Quaternion, WireNoise

WAKE_UP_S = 0.5
"""How long a device that wakes up waits to be told to enter configuration mode."""
FILTER_RATE_HZ = 400
"""Orientations are computed at this rate; slower ones are whole parts of it."""
_MOST_OUTPUTS = 32
_COUNTS = 1 << 16
_FOREIGN_EVERY = 12  # messages: a GNSS receiver at 4 Hz beside orientations at 50 Hz
_BITS = 10  # of one byte on the line, 8N1
_PARAMETER = b"\x21"
_INVALID = b"\x04"
_MEASURED = (Item.QUATERNION, Item.RATE_OF_TURN, Item.DELTA_Q)


@dataclass(frozen=True, slots=True)
class XbusDeviceOptions:
    """What kind of device it is, and in which mood."""

    device_id: bytes = bytes.fromhex("0360a1b2")
    product_code: str = "MTi-3-8A7G6"
    firmware: tuple[int, int, int] = (1, 7, 0)
    filter_profile: bytes = b"General/VRU"
    alignment: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Both alignment rotations."""
    outputs: tuple[tuple[int, int], ...] = (
        (Item.PACKET_COUNTER, setup.MAX_RATE),
        (Item.SAMPLE_TIME_FINE, setup.MAX_RATE),
        (Item.STATUS_WORD, setup.MAX_RATE),
        (Item.QUATERNION, 100),
    )
    """Output configuration in flash at the start."""
    sync: tuple[setup.SyncSetting, ...] = ()
    """Synchronisation settings in flash at the start."""
    baud: int | None = None
    """Speed it runs at; where the host's differs, both sides see garbage. None: any (USB)."""
    measures_at_once: bool = False
    """Streams from the start, as real devices do; else it waits in configuration mode."""
    wakes_up: bool = False
    """Begins with WakeUp and the choice of 500 ms."""
    stuck: bool = False
    """Streams and answers nothing but Reset, until that."""
    gnss: bool = False
    """Messages with foreign time and no orientation come in between."""
    config_delay_s: float = 0.0
    """Goes on streaming for this long before it acknowledges GoToConfig."""
    first_tick: int = 0
    """Its clock at power-up, 100 us ticks."""
    first_counter: int = 0


class XbusDevice:
    """An ``ImuDevice`` on a pty.

    Parameters
    ----------
    link
        Where the host finds the port.
    options
        What kind of device it is.
    wire_noise
        What the wire does to each message on its way to the host.
    """

    def __init__(
        self,
        link: Path,
        *,
        options: XbusDeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options = options or XbusDeviceOptions()
        self._line = PtyLine(link)
        self._noise = wire_noise
        self._sync = SyncInputs(options.sync)
        self._felt = InertialSignals()
        self._decoder = XbusCodec()
        self._outputs = tuple(setup.Output(*output) for output in options.outputs)
        self._alignment = dict.fromkeys((0, 1), options.alignment)
        self._modulus = setup.fine_time_modulus(options.product_code) or setup.WRAP_32_BIT
        self._measuring = options.measures_at_once or options.stuck
        self._stuck, self._waking = options.stuck, False
        self._counter = options.first_counter
        self._epoch_ns = self._last_ns = self._messages = self._to_lose = 0
        self._random = random.Random(3)  # noqa: S311 - the same foreign times every run
        self._timer: asyncio.TimerHandle | None = None
        self.sent = 0
        """Samples written to the wire so far, whole."""
        self.flash_writes = 0
        """Sets stored in flash so far."""

    # --- what a simulation does with it -------------------------------------------------------

    @property
    def streaming(self) -> bool:
        """Whether it measures."""
        return self._measuring

    @property
    def rate_hz(self) -> float:
        """Quaternions per second, as configured; 0 if none are."""
        for data_id, rate in self._outputs:
            if data_id & 0xFFF0 in _MEASURED:
                return float(FILTER_RATE_HZ if rate in {0, setup.MAX_RATE} else rate)
        return 0.0

    @property
    def counter(self) -> int:
        """Number of the next message."""
        return self._counter

    @property
    def line_ns(self) -> int:
        """How long a sample takes on a real line of the host's speed, ns."""
        baud = self._line.host_baud
        size = len(encode(XbusMessageId.MT_DATA2, self._content(0, 0, (1.0, 0.0, 0.0, 0.0), {})))
        return size * _BITS * 1_000_000_000 // baud if baud else 0

    @property
    def outputs(self) -> tuple[setup.Output, ...]:
        """Output configuration in force."""
        return self._outputs

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now, if it measures; ``ImuDevice.push`` says the rest."""
        self._last_ns = device_ns
        self._felt.moved(device_ns, q_world_sensor)
        if not self._measuring:
            return
        if self._options.gnss and self._messages % _FOREIGN_EVERY == _FOREIGN_EVERY - 1:
            self._measure(self._ticks(device_ns) - self._random.randrange(300, 600), None)
        if self._measure(self._ticks(device_ns), q_world_sensor):
            self.sent += 1

    def edge(self, device_ns: int) -> None:
        """Take a rising edge on the first sync input."""
        self._sync.edge(IN1, self._ticks(device_ns) % self._modulus)

    @property
    def sync(self) -> tuple[setup.SyncSetting, ...]:
        """Synchronisation settings in force."""
        return self._sync.entries

    def lose(self, count: int) -> None:
        """Lose the next `count` messages: they take a counter value and are not sent."""
        self._to_lose += count

    def power_cycle(self) -> None:
        """Lose power for a moment: clock and counter begin anew, then the wake-up choice."""
        self._stuck, self._measuring = False, False
        self._epoch_ns, self._counter = self._last_ns, self._options.first_counter
        self._sync.forget()
        self._send(XbusMessageId.WAKE_UP)
        self._waking = True
        self._after(WAKE_UP_S, self._measure_by_itself)

    def unplug(self) -> None:
        """Take the wire away."""
        self._line.unplug()

    def plug(self) -> None:
        """Put the wire back; the device kept its power."""
        self._line.plug()

    async def run(self) -> None:
        """Serve until cancelled."""
        if self._options.wakes_up:
            self.power_cycle()
        try:
            await self._line.serve(self._take)
        finally:
            if self._timer is not None:
                self._timer.cancel()

    # --- what the host says -------------------------------------------------------------------

    def _take(self, data: bytes) -> None:
        if not self._same_speed:
            data = bytes(byte ^ 0x55 for byte in data)
        for event in self._decoder.feed(data):
            if isinstance(event, XbusMessage):
                self._answer(event)

    def _answer(self, message: XbusMessage) -> None:
        if message.mid == XbusMessageId.RESET:
            self._send(XbusMessageId.RESET_ACK)
            self.power_cycle()
        elif self._stuck:
            return
        elif message.mid == XbusMessageId.WAKE_UP_ACK and self._waking:
            self._stop()
        elif message.mid == XbusMessageId.GOTO_CONFIG:
            if self._measuring and self._options.config_delay_s:
                self._after(self._options.config_delay_s, lambda: self._configure(message.bid))
            else:
                self._configure(message.bid)
        elif not self._measuring and message.mid in self._ANSWERS:
            mid, data = self._ANSWERS[message.mid](self, message.data)
            self._send(mid, data, message.bid)

    def _configure(self, bid: int) -> None:
        self._stop()
        self._send(XbusMessageId.GOTO_CONFIG_ACK, b"", bid)

    def _stop(self) -> None:
        self._measuring = self._waking = False
        if self._timer is not None:
            self._timer.cancel()

    def _measure_by_itself(self) -> None:
        self._waking, self._measuring = False, True

    def _go_to_measurement(self, _: bytes) -> tuple[int, bytes]:
        self._send(XbusMessageId.CONFIGURATION, bytes(118))  # a boot message may come first
        self._measuring = True
        return XbusMessageId.GOTO_MEASUREMENT_ACK, b""

    def _device_id(self, _: bytes) -> tuple[int, bytes]:
        return XbusMessageId.DEVICE_ID, self._options.device_id

    def _product_code(self, _: bytes) -> tuple[int, bytes]:
        return XbusMessageId.PRODUCT_CODE, self._options.product_code.ljust(20).encode("ascii")

    def _firmware(self, _: bytes) -> tuple[int, bytes]:
        firmware = setup.Firmware(*self._options.firmware, build=74, scm=0)
        return XbusMessageId.FIRMWARE, setup.encode_firmware(firmware)

    def _filter_profile(self, data: bytes) -> tuple[int, bytes]:
        if data:
            return XbusMessageId.ERROR, _PARAMETER
        return XbusMessageId.FILTER_PROFILE_ACK, self._options.filter_profile

    def _alignment_rotation(self, data: bytes) -> tuple[int, bytes]:
        rotation = setup.decode_alignment(data)
        if rotation is not None:
            self._alignment[rotation.frame] = rotation.q
            self.flash_writes += 1
        frame = data[0] if data else 0
        if frame not in self._alignment:
            return XbusMessageId.ERROR, _PARAMETER
        rotation = setup.AlignmentRotation(frame, self._alignment[frame])
        return XbusMessageId.ALIGNMENT_ROTATION_ACK, setup.encode_alignment(rotation)

    def _output_configuration(self, data: bytes) -> tuple[int, bytes]:
        wanted = setup.decode_outputs(data)
        if wanted is None or len(wanted) > _MOST_OUTPUTS:
            return XbusMessageId.ERROR, _INVALID
        if not all(map(_can_do, wanted)):
            return XbusMessageId.ERROR, _PARAMETER
        if wanted:
            self._outputs = tuple(map(_effective, wanted))
            self.flash_writes += 1
        return XbusMessageId.OUTPUT_CONFIGURATION_ACK, setup.encode_outputs(self._outputs)

    def _sync_settings(self, data: bytes) -> tuple[int, bytes]:
        if not data:
            return XbusMessageId.SYNC_SETTINGS_ACK, setup.encode_sync(self._sync.entries)
        if not self._sync.store(data):
            return XbusMessageId.ERROR, _INVALID
        self.flash_writes += 1
        return XbusMessageId.SYNC_SETTINGS_ACK, b""

    _ANSWERS: dict[int, Callable[[XbusDevice, bytes], tuple[int, bytes]]] = {  # noqa: RUF012 - a table
        XbusMessageId.GOTO_MEASUREMENT: _go_to_measurement,
        XbusMessageId.REQ_DEVICE_ID: _device_id,
        XbusMessageId.REQ_PRODUCT_CODE: _product_code,
        XbusMessageId.REQ_FIRMWARE: _firmware,
        XbusMessageId.FILTER_PROFILE: _filter_profile,
        XbusMessageId.ALIGNMENT_ROTATION: _alignment_rotation,
        XbusMessageId.OUTPUT_CONFIGURATION: _output_configuration,
        XbusMessageId.SYNC_SETTINGS: _sync_settings,
    }

    # --- what it says -------------------------------------------------------------------------

    @property
    def _same_speed(self) -> bool:
        return self._options.baud in {None, self._line.host_baud}

    def _after(self, delay_s: float, act: Callable[[], None]) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(delay_s, act)

    def _send(self, mid: int, data: bytes = b"", bid: int = MASTER) -> bool:
        wire = encode(mid, data, bid)
        if not self._same_speed:  # one speed read as another: as many bytes, none of them right
            wire = bytes((byte * 7 + 1) & 0x7F for byte in wire)
        return self._line.write(self._noise(wire))

    def _ticks(self, device_ns: int) -> int:
        return self._options.first_tick + (device_ns - self._epoch_ns) // setup.TICK_NS

    def _measure(self, ticks: int, q: Quaternion | None) -> bool:
        """Send one MTData2; whether all of it went out."""
        counter = self._counter
        self._counter = (counter + 1) % _COUNTS
        self._messages += 1
        if self._to_lose:
            self._to_lose -= 1
            return False
        edges = self._sync.next_triggers([data_id for data_id, _ in self._outputs])
        data = self._content(counter, ticks % self._modulus, q, edges)
        return self._send(XbusMessageId.MT_DATA2, data)

    def _content(
        self, counter: int, ticks: int, q: Quaternion | None, edges: Mapping[int, Trigger]
    ) -> bytes:
        """Return the data of one MTData2."""
        felt = self._felt
        said = (
            (data_id, edges.get(data_id, _value(data_id, counter, ticks, q, felt)))
            for data_id, _ in self._outputs
        )
        return mtdata2.encode_items((item, value) for item, value in said if value is not None)


def _value(
    data_id: int, counter: int, ticks: int, q: Quaternion | None, felt: InertialSignals
) -> Value | None:
    """Return what an item of a message holds; None if the message does without it."""
    simple: dict[int, Value] = {
        Item.PACKET_COUNTER: counter,
        Item.SAMPLE_TIME_FINE: ticks,
        Item.SAMPLE_TIME_COARSE: ticks // 10_000,
        Item.STATUS_WORD: mtdata2.FILTER_VALID,
        Item.STATUS_BYTE: mtdata2.FILTER_VALID,
    }
    if data_id in simple:
        return simple[data_id]
    world, count = mtdata2.world_of(data_id), mtdata2.reals_in(data_id)
    if q is None or world is None or count is None:
        return None
    if data_id & 0xFFF0 == Item.QUATERNION:
        return native_of(q, world)
    return felt.value(data_id & 0xFFF0) or (0.0,) * count


def _can_do(output: setup.Output) -> bool:
    """Whether the device knows this output at this rate."""
    if output.rate not in {0, setup.MAX_RATE} and output.rate > FILTER_RATE_HZ:
        return False
    return mtdata2.reals_in(output.data_id) is not None or output.data_id in set(Item)


def _effective(output: setup.Output) -> setup.Output:
    """Return the output as the device will really send it."""
    if mtdata2.reals_in(output.data_id) is None:
        return setup.Output(output.data_id, setup.MAX_RATE)
    if output.rate in {0, setup.MAX_RATE}:
        return setup.Output(output.data_id, FILTER_RATE_HZ)
    return setup.Output(output.data_id, FILTER_RATE_HZ // ceil(FILTER_RATE_HZ / output.rate))
