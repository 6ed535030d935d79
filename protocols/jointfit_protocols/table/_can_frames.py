"""CAN frames of one device, described by a table, joined to samples.

The frames of a sample arrive in a known order, usually the order of the identifiers. The last frame
completes the sample. A frame that repeats or precedes an earlier frame begins the next sample. A
frame that arrives more than `longest_ns` after the first frame also begins the next sample. Samples
without all their measurements are incomplete and dropped; time, counter and validity may be
missing.

Invariant: frames in, samples out; no bus, no clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.table._fields import MEASURED, FieldReader, TableField

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_protocols.can import CanFrame

CanKey = tuple[int, bool]


class CanTable(NamedTuple):
    """Description of the frames of a device."""

    keys: tuple[CanKey, ...]
    """Identifier of each frame, and whether it has 29 bits, in the order of sending."""
    fields: Mapping[int, TableField]
    """Place of each slot of the record; `TableField.frame` is an index of `keys`."""
    longest_ns: int = 1_000_000_000
    """Most time between the first and the last frame of a sample, ns."""
    names: tuple[str, ...] = ()
    """Names of the frames in reasons."""


class CanSample(NamedTuple):
    """One sample as sent."""

    t_ns: int
    """Stamp of its first frame."""
    values: tuple[float | None, ...]
    """Record of the sample; None for numbers of a missing frame."""
    data: tuple[bytes, ...]
    """Data of its frames; empty for a missing one."""


class CanTableCodec:
    """Decoder of one device's frames to samples; never raises.

    Parameters
    ----------
    table : CanTable
        Description of the frames.
    """

    def __init__(self, table: CanTable) -> None:
        self._table = table
        self.slots = tuple(sorted(table.fields))
        """Slots of a record, in its order."""
        self._parts = [_FramePart(table, number) for number in range(len(table.keys))]
        self._numbers = {key: number for number, key in enumerate(table.keys)}
        self._single = len(table.keys) == 1
        self._start_ns = 0
        self._next = 0  # number of the frame that continues the open sample
        self._datas: list[bytes] = [b""] * len(table.keys)
        self._values: list[float | None] = [None] * len(self.slots)
        self._complete = True  # whether no frame with measurements is missing
        self.messages = 0
        """Well-formed frames of this device."""
        self.incomplete = 0
        """Samples without all their measurements."""
        self.foreign = 0
        """Frames of other devices."""

    def feed(self, frame: CanFrame) -> CanSample | CorruptBytes | None:
        """Return the sample that `frame` completed, or None."""
        t_ns, can_id, data, extended, error, remote = frame
        number = self._numbers.get((can_id, extended))
        if number is None or error or remote:
            self.foreign += 1
            return None

        part = self._parts[number]
        if len(data) < part.size:
            found = f"{len(data)} data bytes, expected {part.size}"
            return CorruptBytes(len(data), f"{part.name}: {found}")
        self.messages += 1
        if self._single:
            return CanSample(t_ns, part.read(data, 0), (data,))

        if self._next and (number < self._next or t_ns - self._start_ns > self._table.longest_ns):
            self._begin()  # the end of the open sample was lost
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
        """Discard an open sample."""
        if self._next:
            self.incomplete += 1
        self._begin()

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
    """The numbers of one frame."""

    def __init__(self, table: CanTable, number: int) -> None:
        slots = sorted(table.fields)
        mine = [slot for slot in slots if table.fields[slot].frame == number]
        reader = FieldReader([table.fields[slot] for slot in mine])
        self.read, self.size = reader.read, reader.size
        self.places = [slots.index(slot) for slot in mine]
        self.measures = any(slot < MEASURED for slot in mine)
        self.name = table.names[number] if table.names else f"frame {number + 1}"


def encode_can_frames(
    table: CanTable, values: Sequence[float], sizes: Sequence[int] | None = None
) -> list[tuple[CanKey, bytes]]:
    """Return identifier and data of each frame of a sample, in the order of sending.

    Parameters
    ----------
    table : CanTable
        Description of the frames.
    values : sequence of float
        The record, as sent, in the order of its slots.
    sizes : sequence of int, optional
        Number of data bytes of each frame; by default the bytes that the fields occupy.

    Raises
    ------
    struct.error, OverflowError
        A number does not fit its place.
    """
    slots = sorted(table.fields)
    frames = []
    for number, key in enumerate(table.keys):
        mine = [at for at, slot in enumerate(slots) if table.fields[slot].frame == number]
        reader = FieldReader([table.fields[slots[at]] for at in mine])
        data = bytearray(reader.size if sizes is None else sizes[number])
        reader.write(data, [values[at] for at in mine])
        frames.append((key, bytes(data)))
    return frames
