"""Assembly of samples from the CAN frames of one device that a table describes.

The frames of a sample arrive in a known order, usually the order of the identifiers. The last frame
completes the sample. The next sample begins with a frame that repeats or precedes an earlier frame,
or that arrives more than `longest_ns` after the first frame. A sample that lacks a measurement is
incomplete, and is dropped. Time, counter and validity may be missing.

Frames with the same identifier are multiplexed: some bits of the data, the multiplexer, identify
the frame. A frame with another multiplexer value is a frame of another device.

Invariant: the codec converts frames to samples. It uses no bus and no clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.table._fields import MEASURED, FieldReader, TableField

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_protocols.can import CanFrame

CanKey = tuple[int, bool]


class Multiplexer(NamedTuple):
    """Bits of the data that distinguish frames with the same identifier.

    The data bytes are read as one little-endian integer, whatever the byte order of the fields.
    """

    mask: int
    """Bits of the multiplexer."""
    values: frozenset[int]
    """Values of these bits in the frame, at their positions in the integer."""

    @property
    def size(self) -> int:
        """Smallest number of data bytes that contain the multiplexer."""
        return (self.mask.bit_length() + 7) // 8

    def matches(self, data: bytes) -> bool:
        """Return whether the data belong to the frame."""
        return len(data) >= self.size and int.from_bytes(data, "little") & self.mask in self.values

    def __and__(self, other: Multiplexer) -> Multiplexer:
        """Return the multiplexer of the data that match both multiplexers."""
        shared = self.mask & other.mask
        values = frozenset(
            one | another
            for one in self.values
            for another in other.values
            if one & shared == another & shared
        )
        return Multiplexer(self.mask | other.mask, values)

    def excludes(self, other: Multiplexer) -> bool:
        """Return whether no data match both multiplexers."""
        shared = self.mask & other.mask
        return {value & shared for value in self.values}.isdisjoint(
            value & shared for value in other.values
        )


class CanTable(NamedTuple):
    """Layout of the frames of a device."""

    keys: tuple[CanKey, ...]
    """Identifier of each frame and whether it has 29 bits, in the order of sending."""
    fields: Mapping[int, TableField]
    """Position of each slot of the record. `TableField.frame` is an index of `keys`."""
    longest_ns: int = 1_000_000_000
    """Longest time between the first and the last frame of a sample, ns."""
    names: tuple[str, ...] = ()
    """Names of the frames, for messages to the user."""
    multiplexers: Mapping[int, Multiplexer] = {}
    """Multiplexers of the frames that have one. The keys are indices of `keys`."""


class CanSample(NamedTuple):
    """One sample, with its numbers as sent."""

    t_ns: int
    """Stamp of the first frame, ns."""
    values: tuple[float | None, ...]
    """Record of the sample. Numbers of a missing frame are None."""
    data: tuple[bytes, ...]
    """Data bytes of each frame; empty for a missing frame."""


class CanTableCodec:
    """Codec that converts one device's frames to samples; it never raises.

    Parameters
    ----------
    table : CanTable
        Layout of the frames.
    """

    def __init__(self, table: CanTable) -> None:
        self._table = table
        self.slots = tuple(sorted(table.fields))
        """Slots of a record, in the order of its numbers."""
        self._parts = [_FramePart(table, number) for number in range(len(table.keys))]
        self._numbers = {
            key: number for number, key in enumerate(table.keys) if number not in table.multiplexers
        }
        self._multiplexed: dict[CanKey, list[tuple[Multiplexer, int]]] = {}
        for number, multiplexer in table.multiplexers.items():
            self._multiplexed.setdefault(table.keys[number], []).append((multiplexer, number))
        self._single = len(table.keys) == 1
        self._start_ns = 0
        self._next = 0  # number of the frame that continues the current sample
        self._datas: list[bytes] = [b""] * len(table.keys)
        self._values: list[float | None] = [None] * len(self.slots)
        self._complete = True  # whether no frame with measurements is missing
        self.messages = 0
        """Number of well-formed frames of this device."""
        self.incomplete = 0
        """Number of samples that lack a measurement."""
        self.foreign = 0
        """Number of frames of other devices."""
        self.unmatched = 0
        """Number of frames with the identifier of a multiplexed frame, but other data."""

    def feed(self, frame: CanFrame) -> CanSample | CorruptBytes | None:
        """Return the sample that `frame` completes; None if it completes none."""
        t_ns, can_id, data, extended, error, remote = frame
        number = self._numbers.get((can_id, extended))
        if number is None and self._multiplexed:
            number = self._select((can_id, extended), data)
        if number is None or error or remote:
            self.foreign += 1
            return None

        part = self._parts[number]
        part.has_arrived = True
        if len(data) < part.size:
            found = f"{len(data)} data bytes, expected {part.size}"
            return CorruptBytes(len(data), f"{part.name}: {found}")
        self.messages += 1
        if self._single:
            return CanSample(t_ns, part.read(data, 0), (data,))

        if self._next and (number < self._next or t_ns - self._start_ns > self._table.longest_ns):
            self._begin()  # the end of the current sample was lost
            self.incomplete += 1
        if not self._next:
            self._start_ns = t_ns
        for skipped in range(self._next, number):
            self._complete = self._complete and not self._parts[skipped].measures
        for place, value in zip(part.places, part.read(data, 0), strict=True):
            self._values[place] = value
        self._datas[number] = data
        self._next = number + 1
        return self._finish() if self._next == len(self._parts) else None

    def flush(self) -> None:
        """Discard an incomplete sample."""
        if self._next:
            self.incomplete += 1
        self._begin()

    @property
    def absent(self) -> tuple[str, ...]:
        """Names and identifiers of the frames that have never arrived."""
        return tuple(
            f"{part.name} (0x{self._table.keys[number][0]:X})"
            for number, part in enumerate(self._parts)
            if not part.has_arrived
        )

    def _select(self, key: CanKey, data: bytes) -> int | None:
        """Return the number of the multiplexed frame that has these data; None if there is none."""
        pages = self._multiplexed.get(key, ())
        for multiplexer, number in pages:
            if multiplexer.matches(data):
                return number
        self.unmatched += bool(pages)
        return None

    def _finish(self) -> CanSample | None:
        sample = None
        if self._complete:
            sample = CanSample(self._start_ns, tuple(self._values), tuple(self._datas))
        else:
            self.incomplete += 1
        self._begin()
        return sample

    def _begin(self) -> None:
        self._next, self._complete = 0, True
        self._datas = [b""] * len(self._parts)
        self._values = [None] * len(self.slots)


class _FramePart:
    """Numbers that one frame contains."""

    def __init__(self, table: CanTable, number: int) -> None:
        slots = sorted(table.fields)
        mine = [slot for slot in slots if table.fields[slot].frame == number]
        reader = FieldReader([table.fields[slot] for slot in mine])
        self.read, self.size = reader.read, reader.size
        self.places = [slots.index(slot) for slot in mine]
        self.measures = any(slot < MEASURED for slot in mine)
        self.name = table.names[number] if table.names else f"frame {number + 1}"
        self.has_arrived = False


def encode_can_frames(
    table: CanTable, values: Sequence[float], sizes: Sequence[int] | None = None
) -> list[tuple[CanKey, bytes]]:
    """Return the identifier and the data of each frame of a sample, in the order of sending.

    Parameters
    ----------
    table : CanTable
        Layout of the frames.
    values : sequence of float
        Record with the numbers as sent, in the order of its slots.
    sizes : sequence of int, optional
        Number of data bytes of each frame. By default, it is the number of bytes that the fields
        use.

    Raises
    ------
    struct.error, OverflowError
        A number does not fit into its field.
    """
    slots = sorted(table.fields)
    frames = []
    for number, key in enumerate(table.keys):
        mine = [at for at, slot in enumerate(slots) if table.fields[slot].frame == number]
        reader = FieldReader([table.fields[slots[at]] for at in mine])
        multiplexer = table.multiplexers.get(number)
        size = max(reader.size, multiplexer.size if multiplexer else 0)
        data = bytearray(size if sizes is None else sizes[number])
        if multiplexer:
            data[:] = min(multiplexer.values).to_bytes(len(data), "little")
        reader.write(data, [values[at] for at in mine])
        frames.append((key, bytes(data)))
    return frames
