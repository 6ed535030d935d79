"""Virtual Xsens MTi-600 on a shared CAN bus: sends XCDI messages, and simulates faults on request.

A group is the set of messages of one sample.

Invariant: clock and group counter continue while the host does not receive.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_protocols.can import STANDARD_MAX, CanFrame, frame_bits
from jointfit_protocols.xcdi import (
    COUNTER_MODULUS,
    OVERFLOW,
    TICK_NS,
    TICKS_MODULUS,
    DataId,
    XcdiIds,
    encode,
    layout,
    quaternion_counts,
)
from jointfit_simulators.devices._device_wire import CanDevice

if TYPE_CHECKING:
    from jointfit_protocols.xcdi import ByteOrder
    from jointfit_simulators.imu_device import Quaternion
    from jointfit_simulators.wires import CanWire

_FILTER_VALID = 0x02
"""Status word of a device with a valid orientation."""


@dataclass(frozen=True, slots=True)
class XcdiDeviceOptions:
    """Settings of the device, which a user makes over its UART."""

    ids: XcdiIds = field(default_factory=XcdiIds)
    """CAN identifiers. A message with the identifier None is not sent."""
    rate_hz: float = 100.0
    sample_time_unit: str = "100us"
    """Unit of the sample time, ``100us`` or ``1us``. The vendor's documents contradict each other.
    """
    byte_order: ByteOrder = "big"
    first_tick: int = 0
    """Clock value at power-up, ticks."""
    first_counter: int = 0


class XcdiDevice(CanDevice):
    """`ImuDevice` on a CAN wire.

    Parameters
    ----------
    wire
        CAN bus, which several devices may share.
    options
        Settings of the device.
    """

    def __init__(self, wire: CanWire, options: XcdiDeviceOptions | None = None) -> None:
        super().__init__(wire)
        self._options = options or XcdiDeviceOptions()
        self.rate_hz = self._options.rate_hz
        """Configured rate of message groups, Hz."""
        self.counter = self._options.first_counter
        """Number of the next group."""
        self._to_lose: dict[DataId | None, int] = {}  # the key None stands for whole groups

    @property
    def line_ns(self) -> int:
        """Transmission time of a group, ns."""
        ids, bitrate = self._options.ids, self.wire.bitrate
        sent = {
            DataId.SAMPLE_TIME: ids.sample_time,
            DataId.GROUP_COUNTER: ids.group_counter,
            DataId.STATUS_WORD: ids.status_word,
            DataId.QUATERNION: ids.quaternion,
        }

        bits = sum(
            frame_bits(struct.calcsize(f"<{layout(data_id).fields}"), ids.extended)
            for data_id, number in sent.items()
            if number is not None
        )
        return bits * 1_000_000_000 // bitrate if bitrate else 0

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one group now, as described in `ImuDevice.push`."""
        frames = self.group(device_ns, q_world_sensor)
        if self.wire.is_open and frames and self.wire.send(frames):
            self.sent += frames[-1].can_id == self._options.ids.quaternion

    def group(self, device_ns: int, q_world_sensor: Quaternion) -> list[CanFrame]:
        """Return the next group, except the frames that are to be lost."""
        self._last_ns = device_ns
        counter, self.counter = self.counter, (self.counter + 1) % COUNTER_MODULUS
        tick_ns = TICK_NS[self._options.sample_time_unit]
        ticks = self._options.first_tick + (device_ns - self._epoch_ns) // tick_ns
        if self._is_lost(None):
            return []

        ids = self._options.ids
        group: list[tuple[DataId, int | None, tuple[int, ...]]] = [
            (DataId.SAMPLE_TIME, ids.sample_time, (ticks % TICKS_MODULUS,)),
            (DataId.GROUP_COUNTER, ids.group_counter, (counter,)),
            (DataId.STATUS_WORD, ids.status_word, (_FILTER_VALID,)),
            (DataId.QUATERNION, ids.quaternion, quaternion_counts(q_world_sensor)),
        ]
        return [
            self._frame(number, encode(data_id, counts, self._options.byte_order))
            for data_id, number, counts in group
            if number is not None and not self._is_lost(data_id)
        ]

    def lose(self, count: int) -> None:
        """Lose the next `count` groups; the counter increments, but they are not sent."""
        self._to_lose[None] = self._to_lose.get(None, 0) + count

    def lose_frames(self, data_id: DataId, count: int) -> None:
        """Lose the frame `data_id` of the next `count` groups."""
        self._to_lose[data_id] = self._to_lose.get(data_id, 0) + count

    def overflow(self) -> None:
        """Report an overflow of the output buffer."""
        if self._options.ids.error is not None:
            self.wire.send(
                [self._frame(self._options.ids.error, encode(DataId.ERROR, (OVERFLOW,)))]
            )

    def power_cycle(self) -> None:
        """Interrupt the power supply; clock and counter restart."""
        self._epoch_ns, self.counter = self._last_ns, self._options.first_counter

    def _is_lost(self, data_id: DataId | None) -> bool:
        left = self._to_lose.get(data_id, 0)
        if left:
            self._to_lose[data_id] = left - 1
        return left > 0

    def _frame(self, number: int, data: bytes) -> CanFrame:
        extended = self._options.ids.extended or number > STANDARD_MAX
        return CanFrame(0, number, data, extended)
