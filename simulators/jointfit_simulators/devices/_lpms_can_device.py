"""Virtual LP-Research LPMS sensor on CAN, in CANopen, sequential or LP-BUS format.

Invariant: by default, all four channel frames are sent in each period, although two or three
contain no component of the quaternion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.can import CanFrame, frame_bits
from jointfit_protocols.lpms import encode
from jointfit_protocols.lpms.channels import (
    BOOTED,
    FRAME_BYTES,
    HEARTBEAT,
    OPERATIONAL,
    PER_FRAME,
    Precision,
    encode_frames,
    encode_heartbeat,
    tpdo_ids,
)
from jointfit_protocols.lpms.configuration import TABLES, LpmsCommand
from jointfit_protocols.lpms.measurement import PacketLayout
from jointfit_protocols.orientation import native_of
from jointfit_simulators.devices._device_wire import CanDevice

if TYPE_CHECKING:
    from jointfit_protocols.orientation import World
    from jointfit_simulators.imu_device import Quaternion
    from jointfit_simulators.wires import CanWire

WRAPPED = 1300
"""CAN identifier of the frames in which node 0 sends LP-BUS packets."""


@dataclass(frozen=True, slots=True)
class LpmsCanDeviceOptions:
    """Settings of the sensor, which a user makes over its UART."""

    mode: Literal["canopen", "sequential", "lpbus"] = "canopen"
    node: int = 1
    ids: tuple[int, int, int, int] | None = None
    """Identifiers of the channel frames; the default is the CANopen identifiers of `node`."""
    precision: Precision = "int16"
    mapping: tuple[int, int, int, int] = (1, 2, 3, 4)
    """Channel numbers of w, x, y and z, from 1."""
    unit: int = 10_000
    rate_hz: float = 100.0
    world: World = "NWU"
    world_to_sensor: bool = True
    heartbeat_hz: float = 1.0
    """Rate of the CANopen heartbeat, Hz; 0 disables the heartbeat."""
    sends_idle_frames: bool = True
    """Whether channel frames without a component of the quaternion are sent."""
    first_tick: int = 0


class LpmsCanDevice(CanDevice):
    """`ImuDevice` on a CAN wire.

    Parameters
    ----------
    wire
        CAN bus, which several devices may share.
    options
        Settings of the sensor.
    """

    def __init__(self, wire: CanWire, options: LpmsCanDeviceOptions | None = None) -> None:
        super().__init__(wire)
        self._options = options = options or LpmsCanDeviceOptions()
        self.rate_hz = options.rate_hz
        """Configured sample rate, Hz."""
        self._ids = options.ids or tpdo_ids(options.node)
        self._used = {(channel - 1) // PER_FRAME[options.precision] for channel in options.mapping}
        self._layout = PacketLayout(TABLES[1], TABLES[1].quaternion)
        self._beat_ns: int | None = None

        self._to_lose = 0
        self._to_lose_frames: dict[int, int] = {}
        self.swapped = False
        """Whether the frames of a period are sent in descending order."""
        self.counter = 0
        """Number of samples since power-up. The sensor does not send this number."""

    @property
    def line_ns(self) -> int:
        """Transmission time of the frames of one period, ns."""
        bitrate = self.wire.bitrate
        frames = self._period_frames(0, (1.0, 0.0, 0.0, 0.0))
        bits = sum(frame_bits(len(frame.data), extended=False) for frame in frames)
        return bits * NS_PER_S // bitrate if bitrate else 0

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now, as described in `ImuDevice.push`."""
        self._last_ns = device_ns
        self._send_heartbeat(device_ns)
        self.counter += 1
        if self._to_lose:
            self._to_lose -= 1
            return
        frames = self._without_lost(self._period_frames(device_ns, q_world_sensor))
        if self.wire.is_open and frames and self.wire.send(frames):
            self.sent += 1

    def lose(self, count: int) -> None:
        """Lose the next `count` samples."""
        self._to_lose += count

    def lose_frames(self, index: int, count: int) -> None:
        """Lose channel frame `index` (from 0) of the next `count` samples."""
        self._to_lose_frames[index] = self._to_lose_frames.get(index, 0) + count

    def power_cycle(self) -> None:
        """Interrupt the power supply; the first heartbeat afterwards reports a start."""
        self.counter = 0
        if self._options.mode == "canopen":
            self.wire.send([encode_heartbeat(HEARTBEAT + self._options.node, BOOTED)])

    def _send_heartbeat(self, device_ns: int) -> None:
        """Send a heartbeat if one is due."""
        options = self._options
        if options.mode != "canopen" or not options.heartbeat_hz or not self.wire.is_open:
            return
        if self._beat_ns is None or device_ns - self._beat_ns >= NS_PER_S / options.heartbeat_hz:
            self._beat_ns = device_ns
            self.wire.send([encode_heartbeat(HEARTBEAT + options.node, OPERATIONAL)])

    def _native(self, q: Quaternion) -> tuple[float, float, float, float]:
        w, x, y, z = native_of(q, self._options.world)
        return (w, -x, -y, -z) if self._options.world_to_sensor else (w, x, y, z)

    def _period_frames(self, device_ns: int, q: Quaternion) -> list[CanFrame]:
        """Return the frames of one period."""
        if self._options.mode == "lpbus":
            return self._wrapped_frames(device_ns, q)
        frames = self._channel_frames(q)
        return frames[::-1] if self.swapped else frames

    def _without_lost(self, frames: list[CanFrame]) -> list[CanFrame]:
        """Return the frames except those that are to be lost next."""
        sent = []
        for frame in frames:
            index = self._ids.index(frame.can_id) if frame.can_id in self._ids else -1
            left = self._to_lose_frames.get(index, 0)
            if left:
                self._to_lose_frames[index] = left - 1
            else:
                sent.append(frame)
        return sent

    def _channel_frames(self, q: Quaternion) -> list[CanFrame]:
        """Return the frames of one period in channel mode, by ascending identifier."""
        options = self._options
        unit = options.unit if options.precision == "int16" else 1
        channels = [0.0] * (4 * PER_FRAME[options.precision])
        for channel, part in zip(options.mapping, self._native(q), strict=True):
            channels[channel - 1] = part * unit

        return [
            frame
            for index, frame in enumerate(encode_frames(self._ids, channels, options.precision))
            if index in self._used or options.sends_idle_frames
        ]

    def _wrapped_frames(self, device_ns: int, q: Quaternion) -> list[CanFrame]:
        """Return an LP-BUS data packet in frames of at most 8 bytes."""
        tick = self._options.first_tick + device_ns * TABLES[1].tick_hz // NS_PER_S
        data = self._layout.encode(tick, self._native(q), floats=True)
        wire = encode(LpmsCommand.DATA, data, self._options.node)
        number = WRAPPED + self._options.node
        return [
            CanFrame(0, number, wire[at : at + FRAME_BYTES])
            for at in range(0, len(wire), FRAME_BYTES)
        ]
