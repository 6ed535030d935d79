"""Data packets of LPMS sensors: device time, followed by the enabled outputs in a fixed order.

    | tick U4 | value ... |      each value float32, or int16

U4 is an unsigned integer of 4 bytes. The packet does not state which outputs it contains. The
output mask is read from the device and determines the order of the values. The length of the packet
shows whether the values have 32 or 16 bits.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_protocols.lpms.configuration import CommandTable

TICK_MODULUS = 1 << 32
"""Number of ticks after which device time wraps."""
_TICK = struct.Struct("<I")
_SECONDS = struct.Struct("<f")


class LpmsMeasurement(NamedTuple):
    """Content of one data packet, with the values as sent."""

    tick: int
    values: tuple[float, ...]
    """Values in the order of the packet. They are integers if `floats` is false."""
    floats: bool


class PacketLayout:
    """Positions of the outputs in the data packets for one output mask.

    Parameters
    ----------
    table : CommandTable
        Commands and outputs of the sensor generation.
    mask : int
        Mask of the enabled outputs.
    """

    def __init__(self, table: CommandTable, mask: int) -> None:
        self.places: dict[str, slice] = {}
        """Indices of the values of each output, by the name of the output."""
        count = 0
        for name, bit, values in table.outputs:
            if mask >> bit & 1:
                self.places[name] = slice(count, count + values)
                count += values
        self.values = count
        """Number of values in a packet."""
        self._floats = struct.Struct(f"<I{count}f")
        self._shorts = struct.Struct(f"<I{count}h")
        self.sizes = (self._floats.size, self._shorts.size)
        """Lengths of a packet with 32-bit values and with 16-bit values, bytes."""

    def decode(self, data: bytes) -> LpmsMeasurement | None:
        """Return the content of a data packet; None if its length does not match the outputs."""
        size = len(data)
        if size == self._floats.size:
            tick, *values = self._floats.unpack(data)
            return LpmsMeasurement(tick, tuple(values), True)
        if size == self._shorts.size:
            tick, *values = self._shorts.unpack(data)
            return LpmsMeasurement(tick, tuple(values), False)
        return None

    def encode(self, tick: int, values: Sequence[float], *, floats: bool) -> bytes:
        """Return the data of a packet. Integers are limited to 16 bits.

        Raises
        ------
        ValueError
            The number of values does not match the outputs.
        """
        if len(values) != self.values:
            raise ValueError(f"{len(values)} values: these outputs have {self.values}")
        if floats:
            return self._floats.pack(tick % TICK_MODULUS, *values)
        counts = (max(-0x8000, min(0x7FFF, round(value))) for value in values)
        return self._shorts.pack(tick % TICK_MODULUS, *counts)


def seconds_of(tick: int) -> float:
    """Return the device time of old firmware, which sends float32 seconds instead of ticks."""
    (seconds,) = _SECONDS.unpack(_TICK.pack(tick))
    return float(seconds)


def tick_of(seconds: float) -> int:
    """Return the number that old firmware sends for a device time in seconds."""
    (tick,) = _TICK.unpack(_SECONDS.pack(seconds))
    return int(tick)
