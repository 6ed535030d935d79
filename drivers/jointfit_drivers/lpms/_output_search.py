"""Search for the place of the quaternion in data packets whose outputs are unknown.

A data packet does not name its outputs. If a recording lacks the replies to the driver's requests,
or if it was made while another program used the sensor, only the length of the packets is known.
The outputs have a fixed order, so few places are possible for the quaternion. The norm of the
quaternion is 1 in every packet. The norm of an acceleration in g may also be 1 at rest, but with a
larger deviation.

Invariant: the result depends only on the packets fed; at most `_MOST_HELD` packets are stored.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.model import DeviceEvent
from jointfit_protocols.lpms import unit_of
from jointfit_protocols.lpms.measurement import PacketLayout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Decoded
    from jointfit_protocols.lpms import LpBusMessage
    from jointfit_protocols.lpms.configuration import CommandTable, LpmsOutput

_EXAMINED = (4, 16, 32, 64, 128, 256)
"""Numbers of stored packets at which the places are examined. They grow geometrically, so that the
total time is proportional to the number of packets."""
_DECIDING, _MOST_HELD = _EXAMINED[1], _EXAMINED[-1]
"""Number of packets at which a search ends if only one place is possible, and number of packets at
which it always ends."""
_TOLERANCE = 0.01
"""Largest deviation of the norm from 1."""
_CLEARER = 5.0
"""The place with the smallest deviation is selected if the second-smallest deviation is at least
this many times as large."""
_ROUNDING = 1e-4
"""Deviation of a norm that rounding alone can cause. A smaller deviation counts as this value."""


class ArrivedPacket(NamedTuple):
    """A data packet and the arrival of its first byte, monotonic ns."""

    message: LpBusMessage
    arrival_ns: int


class OutputSearch:
    """Search for the outputs of one sensor.

    Parameters
    ----------
    table : CommandTable
        Commands and outputs of the sensor's generation.
    """

    def __init__(self, table: CommandTable) -> None:
        self._table = table
        self._alone = PacketLayout(table, table.quaternion)
        self.layout = self._alone
        """Layout of the packets. Until another layout is found, packets are assumed to contain
        only the quaternion."""
        self._candidates: dict[int, list[PacketLayout]] = {}
        self._size: int | None = None  # size of the packets of `layout`, bytes
        self._held: list[ArrivedPacket] = []
        self.events: list[Decoded] = []
        """Events that were not returned yet."""

    def take(self, packet: ArrivedPacket) -> list[ArrivedPacket]:
        """Add a packet; return the packets, in order, that can be decoded by `layout`."""
        data = packet.message.data
        if len(data) == self._size:
            return [packet]
        if not self._held and _deviation(self._alone, data) is not None:
            self.layout, self._size = self._alone, len(data)
            return [packet]

        ready: list[ArrivedPacket] = []
        if self._held and len(self._held[0].message.data) != len(data):
            ready = self._end(self._alone)
        self._held.append(packet)
        count = len(self._held)
        if count in _EXAMINED:
            found = self._find()
            if not found or count >= (_DECIDING if len(found) == 1 else _MOST_HELD):
                ready += self._end(found[0] if len(found) == 1 else self._alone)
        return ready

    def flush(self) -> list[ArrivedPacket]:
        """End the search, set `layout`, and return the stored packets."""
        found = self._find() if self._held else []
        return self._end(found[0] if len(found) == 1 else self._alone) if self._held else []

    def release(self) -> list[ArrivedPacket]:
        """Return the stored packets without a search, after a reply has named the outputs."""
        ready, self._held = self._held, []
        return ready

    def _end(self, layout: PacketLayout) -> list[ArrivedPacket]:
        ready, self._held = self._held, []
        self.layout, self._size = layout, len(ready[0].message.data)
        if layout is not self._alone:
            place = layout.places["quaternion"]
            precision = "float32" if self._size == layout.sizes[0] else "int16"
            text = (
                "the outputs are unknown, because the sensor did not report its settings: values "
                f"{place.start + 1} to {place.stop} of {layout.values} ({precision}) "
                "have norm 1 and are used as the quaternion"
            )
            known = {"first_value": place.start + 1, "precision": precision}
            self.events.append(DeviceEvent("info", text, known))
        return ready

    def _find(self) -> list[PacketLayout]:
        """Return the layouts that fit the stored packets, or only the clearly best layout."""
        rated = []
        size = len(self._held[0].message.data)
        if size not in self._candidates:
            self._candidates[size] = self._layouts(size)
        for layout in self._candidates[size]:
            deviations = [_deviation(layout, packet.message.data) for packet in self._held]
            known = [one for one in deviations if one is not None]
            if len(known) == len(deviations):
                rated.append((max(_ROUNDING, sqrt(sum(x * x for x in known) / len(known))), layout))
        rated.sort(key=lambda one: one[0])
        if len(rated) > 1 and rated[1][0] >= _CLEARER * rated[0][0]:
            return [rated[0][1]]
        return [layout for _, layout in rated]

    def _layouts(self, size: int) -> list[PacketLayout]:
        """Return a layout for each possible place of the quaternion in packets of `size` bytes."""
        outputs = self._table.outputs
        at = next(k for k, output in enumerate(outputs) if output.name == "quaternion")
        before, behind = _masks(outputs[:at]), _masks(outputs[at + 1 :])
        found = []
        for width in (4, 2):
            rest, odd = divmod(size - 4 - 4 * width, width)
            found += [
                PacketLayout(self._table, mask | self._table.quaternion | behind[rest - first])
                for first, mask in before.items()
                if not odd and rest - first in behind
            ]
        return found


def _masks(outputs: Sequence[LpmsOutput]) -> dict[int, int]:
    """Return the bit mask of one subset of `outputs` for each possible total number of values."""
    masks = {0: 0}
    for output in outputs:
        for count, mask in list(masks.items()):
            masks.setdefault(count + output.values, mask | 1 << output.bit)
    return masks


def _deviation(layout: PacketLayout, data: bytes) -> float | None:
    """Return the deviation of the quaternion's norm from 1; None if the norm is implausible."""
    measurement = layout.decode(data)
    if measurement is None:
        return None
    values = measurement.values[layout.places["quaternion"]]
    square = sum(value * value for value in values)
    if not isfinite(square):
        return None
    if measurement.floats:
        deviation = abs(sqrt(square) - 1)
        return deviation if deviation <= _TOLERANCE else None
    unit = unit_of(values)
    return None if unit is None else abs(sqrt(square) / unit - 1)
