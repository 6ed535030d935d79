"""Virtual Xsens / Movella device, which sends Xbus messages on a pseudo-terminal (pty).

Invariants (as in real devices): the device streams until it acknowledges GoToConfig. It rejects an
invalid output configuration with error 0x21, and acknowledges a valid one with the actual rates. It
stores each setting in flash at once, and sends WakeUp after power-up. Source: MT0101P rev. 2020.A.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_protocols.orientation import native_of
from jointfit_protocols.xbus import MASTER, XbusCodec, XbusMessage, XbusMessageId, encode, mtdata2
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.xbus.sync_lines import IN1
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._xbus_legacy import legacy_content, legacy_reply
from jointfit_simulators.devices._xbus_sync_inputs import SyncInputs
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_protocols.orientation import World
    from jointfit_protocols.xbus.mtdata import MTDataLayout
    from jointfit_protocols.xbus.mtdata2 import Trigger, Value
    from jointfit_simulators.imu_device import Quaternion, WireNoise

WAKE_UP_S = 0.5
"""Time after WakeUp in which the host can select configuration mode, s."""
FILTER_RATE_HZ = 400
"""Rate of the orientation filter, Hz. The ratio of this rate to an output rate is an integer."""
_MOST_OUTPUTS = 32
"""Maximum number of items in an output configuration."""
_COUNTS = 1 << 16
"""Modulus of the packet counter."""
_FOREIGN_EVERY = 12
"""Every twelfth message is from a GNSS receiver. With orientations at 50 Hz, this is 4.5 Hz."""
_PARAMETER = b"\x21"
"""Error code for a parameter out of range."""
_INVALID = b"\x04"
"""Error code for an invalid message."""
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_MEASURED = (Item.QUATERNION, Item.RATE_OF_TURN, Item.DELTA_Q)
"""Items that define the sample rate."""


@dataclass(frozen=True, slots=True)
class XbusDeviceOptions:
    """Model, settings and faults of a device."""

    device_id: bytes = bytes.fromhex("0360a1b2")
    product_code: str = "MTi-3-8A7G6"
    firmware: tuple[int, int, int] = (1, 7, 0)
    filter_profile: bytes = b"General/VRU"
    alignment: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Initial value of both alignment rotations."""
    outputs: tuple[tuple[int, int], ...] = (
        (Item.PACKET_COUNTER, setup.MAX_RATE),
        (Item.SAMPLE_TIME_FINE, setup.MAX_RATE),
        (Item.STATUS_WORD, setup.MAX_RATE),
        (Item.QUATERNION, 100),
    )
    """Output configuration that is initially in flash."""
    sync: tuple[setup.SyncSetting, ...] = ()
    """Synchronisation settings that are initially in flash."""
    baud: int | None = None
    """Line speed of the device, bit/s. At another speed, both sides receive invalid bytes. None
    accepts any speed (USB)."""
    measures_at_once: bool = False
    """Whether the device streams from the start. Otherwise, it starts in configuration mode."""
    wakes_up: bool = False
    """Whether the device sends WakeUp at the start and waits `WAKE_UP_S` for the reply."""
    stuck: bool = False
    """Whether the device streams and ignores all requests. The request Reset ends this fault."""
    legacy: MTDataLayout | None = None
    """Message layout (MTData) of an older device, which supports no output configuration."""
    legacy_world: World = "NWU"
    legacy_hz: float = 100.0
    legacy_skip: int = 0
    """Number of samples that are omitted after each MTData message."""
    gnss: bool = False
    """Whether messages of a GNSS receiver are inserted. They have their own time and no
    orientation."""
    config_delay_s: float = 0.0
    """Time until the device acknowledges GoToConfig, s. Until then, it streams."""
    first_tick: int = 0
    """Clock value at power-up, in ticks of 100 us."""
    first_counter: int = 0


class XbusDevice(SerialDevice):
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
        options: XbusDeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options = options or XbusDeviceOptions()
        super().__init__(link, wire_noise, options.baud)
        self._sync = SyncInputs(options.sync)
        self._inertial = InertialSignals()
        self._decoder = XbusCodec()

        self.outputs = tuple(setup.Output(*output) for output in options.outputs)
        """Active output configuration."""
        self._alignment = dict.fromkeys((0, 1), options.alignment)
        self._modulus = setup.fine_time_modulus(options.product_code) or setup.WRAP_32_BIT
        self.streaming = options.measures_at_once or options.stuck
        """Whether the device is in measurement mode."""
        self._stuck, self._waking = options.stuck, False
        self.counter = options.first_counter
        """Number of the next message."""
        self._messages = 0
        self._random = random.Random(3)  # noqa: S311 - the same GNSS times in every run
        self.flash_writes = 0
        """Number of write operations to flash."""

    # --- control by the simulation ------------------------------------------------------------

    @property
    def rate_hz(self) -> float:
        """Configured sample rate, Hz; 0 without an item that defines the rate."""
        if self._options.legacy is not None:
            return self._options.legacy_hz
        for data_id, rate in self.outputs:
            if data_id & 0xFFF0 in _MEASURED:
                return float(FILTER_RATE_HZ if rate in {0, setup.MAX_RATE} else rate)
        return 0.0

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return len(encode(XbusMessageId.MT_DATA2, self._content(0, 0, (1.0, 0.0, 0.0, 0.0), {})))

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now in measurement mode, as described in `ImuDevice.push`."""
        self._last_ns = device_ns
        self._inertial.update(device_ns, q_world_sensor)
        if not self.streaming:
            return
        if self._options.gnss and self._messages % _FOREIGN_EVERY == _FOREIGN_EVERY - 1:
            self._measure(self._ticks(device_ns) - self._random.randrange(300, 600), None)
        if self._measure(self._ticks(device_ns), q_world_sensor):
            self.sent += 1

    @override
    def edge(self, device_ns: int) -> None:
        """Add a rising edge on the first sync input."""
        self._sync.edge(IN1, self._ticks(device_ns) % self._modulus)

    @property
    def sync(self) -> tuple[setup.SyncSetting, ...]:
        """Active synchronisation settings."""
        return self._sync.entries

    def power_cycle(self) -> None:
        """Interrupt the power supply: clock and counter restart, and WakeUp is sent."""
        self._stuck, self.streaming = False, False
        self._epoch_ns, self.counter = self._last_ns, self._options.first_counter
        self._sync.reset()
        self._send(XbusMessageId.WAKE_UP)
        self._waking = True

        def measure() -> None:
            self._waking, self.streaming = False, True

        self._after(WAKE_UP_S, measure)

    @override
    async def run(self) -> None:
        """Run the device until cancelled."""
        if self._options.wakes_up:
            self.power_cycle()
        await super().run()

    # --- requests of the host -----------------------------------------------------------------

    @override
    def _receive(self, data: bytes) -> None:
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
            # The device streams until it acknowledges the request.
            if self.streaming and self._options.config_delay_s:
                self._after(self._options.config_delay_s, lambda: self._configure(message.bid))
            else:
                self._configure(message.bid)
        elif not self.streaming and (reply := self._reply_of_age(message.mid, message.data)):
            self._send(*reply, message.bid)

    def _configure(self, bid: int) -> None:
        self._stop()
        self._send(XbusMessageId.GOTO_CONFIG_ACK, b"", bid)

    def _stop(self) -> None:
        self.streaming = self._waking = False
        if self._timer is not None:
            self._timer.cancel()

    def _reply_of_age(self, mid: int, data: bytes) -> tuple[int, bytes] | None:
        """Return the reply; requests for the format of another generation yield an error.

        Older devices send MTData, and newer devices send MTData2.
        """
        options = self._options
        if options.legacy is None:
            unknown = mid in {XbusMessageId.OUTPUT_MODE, XbusMessageId.OUTPUT_SETTINGS}
        else:
            unknown = mid == XbusMessageId.OUTPUT_CONFIGURATION
            rate_hz, skip = options.legacy_hz, options.legacy_skip
            if (reply := legacy_reply(options.legacy, rate_hz, skip, mid)) is not None:
                return reply
        return (XbusMessageId.ERROR, _INVALID) if unknown else self._reply(mid, data)

    def _reply(self, mid: int, data: bytes) -> tuple[int, bytes] | None:
        """Return identifier and data of the answer in configuration mode; None for no answer."""
        options = self._options
        reply: tuple[int, bytes] | None = None
        match mid:
            case XbusMessageId.GOTO_MEASUREMENT:
                self._send(XbusMessageId.CONFIGURATION, bytes(118))  # as some devices do
                self.streaming = True
                reply = XbusMessageId.GOTO_MEASUREMENT_ACK, b""
            case XbusMessageId.REQ_DEVICE_ID:
                reply = XbusMessageId.DEVICE_ID, options.device_id
            case XbusMessageId.REQ_PRODUCT_CODE:
                reply = XbusMessageId.PRODUCT_CODE, options.product_code.ljust(20).encode("ascii")
            case XbusMessageId.REQ_FIRMWARE:
                firmware = setup.Firmware(*options.firmware, build=74, scm=0)
                reply = XbusMessageId.FIRMWARE, setup.encode_firmware(firmware)
            case XbusMessageId.FILTER_PROFILE:
                acknowledged = XbusMessageId.FILTER_PROFILE_ACK, options.filter_profile
                reply = (XbusMessageId.ERROR, _PARAMETER) if data else acknowledged
            case XbusMessageId.ALIGNMENT_ROTATION:
                reply = self._alignment_rotation(data)
            case XbusMessageId.OUTPUT_CONFIGURATION:
                reply = self._output_configuration(data)
            case XbusMessageId.SYNC_SETTINGS:
                reply = self._sync_settings(data)
        return reply

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
        if not all(map(_is_supported, wanted)):
            return XbusMessageId.ERROR, _PARAMETER
        if wanted:
            self.outputs = tuple(map(_effective, wanted))
            self.flash_writes += 1
        return XbusMessageId.OUTPUT_CONFIGURATION_ACK, setup.encode_outputs(self.outputs)

    def _sync_settings(self, data: bytes) -> tuple[int, bytes]:
        if not data:
            return XbusMessageId.SYNC_SETTINGS_ACK, setup.encode_sync(self._sync.entries)
        if not self._sync.store(data):
            return XbusMessageId.ERROR, _INVALID
        self.flash_writes += 1
        return XbusMessageId.SYNC_SETTINGS_ACK, b""

    # --- messages to the host -----------------------------------------------------------------

    def _send(self, mid: int, data: bytes = b"", bid: int = MASTER) -> bool:
        return self._write(encode(mid, data, bid))

    def _ticks(self, device_ns: int) -> int:
        return self._options.first_tick + (device_ns - self._epoch_ns) // setup.TICK_NS

    def _measure(self, ticks: int, q: Quaternion | None) -> bool:
        """Send one message (MTData2, or MTData if legacy); return whether all of it was sent."""
        counter = self.counter
        self.counter = (counter + 1) % _COUNTS
        self._messages += 1
        if self._to_lose:
            self._to_lose -= 1
            return False
        layout, world = self._options.legacy, self._options.legacy_world
        if layout is not None:
            content = legacy_content(layout, world, counter, q or _UPRIGHT, self._inertial)
            return self._send(XbusMessageId.MT_DATA, content)
        edges = self._sync.next_triggers([data_id for data_id, _ in self.outputs])
        data = self._content(counter, ticks % self._modulus, q, edges)
        return self._send(XbusMessageId.MT_DATA2, data)

    def _content(
        self, counter: int, ticks: int, q: Quaternion | None, edges: Mapping[int, Trigger]
    ) -> bytes:
        """Return the data of one MTData2 message; without an orientation it is a GNSS message."""
        values = (
            (data_id, edges.get(data_id, _value(data_id, counter, ticks, q, self._inertial)))
            for data_id, _ in self.outputs
        )
        return mtdata2.encode_items((item, value) for item, value in values if value is not None)


def _value(
    data_id: int, counter: int, ticks: int, q: Quaternion | None, inertial: InertialSignals
) -> Value | None:
    """Return the value of an item in a message; None if the message omits the item."""
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
    return inertial.value(data_id & 0xFFF0) or (0.0,) * count


def _is_supported(output: setup.Output) -> bool:
    """Return whether the device supports this output at this rate."""
    if output.rate not in {0, setup.MAX_RATE} and output.rate > FILTER_RATE_HZ:
        return False
    return mtdata2.reals_in(output.data_id) is not None or output.data_id in set(Item)


def _effective(output: setup.Output) -> setup.Output:
    """Return the output with the rate at which the device sends it."""
    if mtdata2.reals_in(output.data_id) is None:
        return setup.Output(output.data_id, setup.MAX_RATE)
    if output.rate in {0, setup.MAX_RATE}:
        return setup.Output(output.data_id, FILTER_RATE_HZ)
    return setup.Output(output.data_id, FILTER_RATE_HZ // ceil(FILTER_RATE_HZ / output.rate))
