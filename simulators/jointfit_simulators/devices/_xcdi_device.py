"""Virtual Xsens MTi-600 on CAN: XCDI groups on a shared wire, with faults.

Invariant: clock and group counter continue while the host does not listen.
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

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

    from jointfit_protocols.xcdi import ByteOrder
    from jointfit_simulators.imu_device import Quaternion
    from jointfit_simulators.wires import CanWire

_FILTER_VALID = 0x02


@dataclass(frozen=True, slots=True)
class XcdiDeviceOptions:
    """How the device was configured over its UART."""

    ids: XcdiIds = field(default_factory=XcdiIds)
    """Identifiers; those that are None are not sent."""
    rate_hz: float = 100.0
    sample_time_unit: str = "100us"
    """``100us`` or ``1us``: the documents disagree."""
    byte_order: ByteOrder = "big"
    first_tick: int = 0
    """Its clock at power-up."""
    first_counter: int = 0


class XcdiDevice:
    """An ``ImuDevice`` on a CAN wire.

    Parameters
    ----------
    wire
        The bus; several devices may share it.
    options
        How it was configured.
    """

    def __init__(self, wire: CanWire, options: XcdiDeviceOptions | None = None) -> None:
        self.wire = wire
        self._options = options or XcdiDeviceOptions()
        self._counter = self._options.first_counter
        self._epoch_ns = self._last_ns = 0
        self._lose: dict[DataId | None, int] = {}
        self.sent = 0
        """Samples put on the wire so far (their quaternion, that is)."""

    @property
    def streaming(self) -> bool:
        """Whether the bus is open."""
        return self.wire.is_open

    @property
    def rate_hz(self) -> float:
        """Groups a second, as configured."""
        return self._options.rate_hz

    def edge(self, device_ns: int) -> None:
        """Take an edge and say nothing: there is no message for it."""

    @property
    def counter(self) -> int:
        """Number of the next group."""
        return self._counter

    @property
    def line_ns(self) -> int:
        """How long a group takes on the bus, ns."""
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
        """Send one group now; ``ImuDevice.push`` says the rest."""
        frames = self.group(device_ns, q_world_sensor)
        if not self.wire.is_open or not frames:
            return
        if self.wire.send(frames):
            self.sent += frames[-1].can_id == self._options.ids.quaternion

    def group(self, device_ns: int, q_world_sensor: Quaternion) -> list[CanFrame]:
        """Return the next group, without the frames that are to be lost; see ``interleaved``."""
        self._last_ns = device_ns
        counter, self._counter = self._counter, (self._counter + 1) % COUNTER_MODULUS
        tick_ns = TICK_NS[self._options.sample_time_unit]
        ticks = self._options.first_tick + (device_ns - self._epoch_ns) // tick_ns
        if self._lost(None):
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
            if number is not None and not self._lost(data_id)
        ]

    def lose(self, count: int) -> None:
        """Lose the next `count` groups: they take a counter value and are not sent."""
        self._lose[None] = self._lose.get(None, 0) + count

    def lose_frames(self, data_id: DataId, count: int) -> None:
        """Lose the frame `data_id` of the next `count` groups."""
        self._lose[data_id] = self._lose.get(data_id, 0) + count

    def overflow(self) -> None:
        """Report that the output buffer overflowed."""
        if self._options.ids.error is not None:
            self.wire.send(
                [self._frame(self._options.ids.error, encode(DataId.ERROR, (OVERFLOW,)))]
            )

    def power_cycle(self) -> None:
        """Lose power for a moment: clock and counter begin anew."""
        self._epoch_ns, self._counter = self._last_ns, self._options.first_counter

    def unplug(self) -> None:
        """Take the wire away."""
        self.wire.unplug()

    def plug(self) -> None:
        """Put the wire back; the device kept its power."""
        self.wire.plug()

    async def run(self) -> None:
        """Serve until cancelled."""
        await self.wire.run()

    def _lost(self, what: DataId | None) -> bool:
        left = self._lose.get(what, 0)
        if left:
            self._lose[what] = left - 1
        return left > 0

    def _frame(self, number: int, data: bytes) -> CanFrame:
        extended = self._options.ids.extended or number > STANDARD_MAX
        return CanFrame(0, number, data, extended)


def interleaved(groups: Sequence[Sequence[CanFrame]], order: random.Random) -> list[CanFrame]:
    """Return the frames of several devices' groups mixed, each group in its own order."""
    left = [list(group) for group in groups if group]
    mixed: list[CanFrame] = []
    while left:
        group = order.choice(left)
        mixed.append(group.pop(0))
        left = [each for each in left if each]
    return mixed
