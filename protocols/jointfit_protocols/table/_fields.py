"""Numbers at fixed positions in a frame. The positions are compiled once to ``struct`` formats.

A record is the tuple of all numbers of one sample as sent, in the order of their slots:

    slot   0..3        4..6   7..9          10..12    13    14       15
           quaternion  rate   acceleration  magnetic  time  counter  valid
           w x y z     x y z  x y z         x y z

A record contains only the slots that the device sends. The position of a number consists of its
first byte and the first bit in this byte. Bits are counted from the least significant bit for
little-endian numbers, and from the most significant bit for big-endian numbers.

Invariant: every frame of at least `FieldReader.size` bytes can be read. No layout is interpreted
while samples are read.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable  # noqa: TC003 - types of attributes
from operator import itemgetter
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

ByteOrder = Literal["little", "big"]
Kind = Literal["u", "i", "f"]
Quantity = Literal["quaternion", "rate", "acceleration", "magnetic", "time", "counter", "valid"]

SLOTS: dict[Quantity, range] = {
    "quaternion": range(4),
    "rate": range(4, 7),
    "acceleration": range(7, 10),
    "magnetic": range(10, 13),
    "time": range(13, 14),
    "counter": range(14, 15),
    "valid": range(15, 16),
}
"""Slots of each quantity in a record."""
COMPONENTS = {"quaternion": "wxyz", "rate": "xyz", "acceleration": "xyz", "magnetic": "xyz"}
"""Letters of the components in the order of their slots."""
MEASURED = 13
"""Number of slots for components of measurements. The other slots are integers or times."""

_TYPE = re.compile(r"(?P<kind>[uif])(?P<bits>[1-9]\d?)")
_FLOATS = (16, 32, 64)
_MOST_BITS = 64
_CODES = {
    ("u", 8): "B", ("u", 16): "H", ("u", 32): "I", ("u", 64): "Q",
    ("i", 8): "b", ("i", 16): "h", ("i", 32): "i", ("i", 64): "q",
    ("f", 16): "e", ("f", 32): "f", ("f", 64): "d",
}  # fmt: skip
"""Codes of ``struct`` for each kind and number of bits."""


class TableField(NamedTuple):
    """Position and type of one number."""

    offset: int
    """Index of the first byte in the frame."""
    kind: Kind
    """Unsigned integer, signed integer (two's complement), or float (IEEE 754)."""
    bits: int
    byte_order: ByteOrder = "little"
    bit: int = 0
    """Index of the first bit in the first byte."""
    scale: float = 1.0
    """SI value of one count."""
    zero: float = 0.0
    """SI value of the count 0."""
    frame: int = 0
    """Index of the frame that contains the number, for devices that send several frames per
    sample."""

    @property
    def end(self) -> int:
        """Number of bytes from the start of the frame to the end of this number."""
        return self.offset + (self.bit + self.bits + 7) // 8

    @property
    def modulus(self) -> int:
        """Number of different values of the integer."""
        return 1 << self.bits

    def occupied_bits(self) -> set[int]:
        """Return the frame's bits that this number occupies, each as 8 · byte + significance."""
        first = 8 * self.offset + self.bit
        if self.byte_order == "little":
            return set(range(first, first + self.bits))
        return {at ^ 7 for at in range(first, first + self.bits)}


def parse_type(text: str) -> tuple[Kind, int] | None:
    """Return kind and number of bits of a type such as ``i16`` or ``f32``; None for other texts."""
    match = _TYPE.fullmatch(text)
    if match is None:
        return None
    kind: Kind = "u" if match["kind"] == "u" else "i" if match["kind"] == "i" else "f"
    bits = int(match["bits"])
    least = 2 if kind == "i" else 1  # the sign bit and at least one other bit
    possible = bits in _FLOATS if kind == "f" else least <= bits <= _MOST_BITS
    return (kind, bits) if possible else None


def overlaps(fields: Mapping[str, TableField]) -> list[tuple[str, str]]:
    """Return the pairs of names whose numbers share bits of the same frame."""
    found = []
    named = [(name, field, field.occupied_bits()) for name, field in fields.items()]
    for at, (first, one, bits) in enumerate(named):
        found += [
            (first, second)
            for second, other, others in named[at + 1 :]
            if one.frame == other.frame and bits & others
        ]
    return found


class FieldReader:
    """Reads numbers from frames, in the given order.

    Parameters
    ----------
    fields : sequence of TableField
        Positions of the numbers in one frame, which must not overlap.
    """

    def __init__(self, fields: Sequence[TableField]) -> None:
        self.size = max((field.end for field in fields), default=0)
        """Smallest length of a frame, bytes."""
        orders: tuple[ByteOrder, ByteOrder] = ("little", "big")
        whole = [
            [at for at in _by_place(fields) if _is_whole(fields[at], order)] for order in orders
        ]
        taken = [at for part in whole for at in part]
        split = [at for at in range(len(fields)) if at not in taken]
        structs = [
            struct.Struct(_format([fields[at] for at in part], order))
            for part, order in zip(whole, orders, strict=True)
            if part
        ]
        self._structs = structs
        self._bits = [_BitField(fields[at]) for at in split]
        self._wire_order = [*taken, *split]
        self.read: Callable[[bytes, int], tuple[float, ...]] = self._compile()
        """Return the numbers of the frame that begins at the given index of `data`."""

    def _compile(self) -> Callable[[bytes, int], tuple[float, ...]]:
        """Return the fastest function that reads all numbers."""
        structs, bits, order = self._structs, self._bits, self._wire_order
        if len(structs) == 1 and not bits and order == sorted(order):
            plain: Callable[[bytes, int], tuple[float, ...]] = structs[0].unpack_from
            return plain

        places = [order.index(at) for at in range(len(order))]
        if len(structs) == 1 and not bits:
            unpack = structs[0].unpack_from
            sort: Callable[[tuple[float, ...]], tuple[float, ...]] = itemgetter(*places)

            def read_struct(data: bytes, at: int) -> tuple[float, ...]:
                return sort(unpack(data, at))

            return read_struct

        unpacks = [each.unpack_from for each in structs]
        reads = [each.read for each in bits]

        def read_mixed(data: bytes, at: int) -> tuple[float, ...]:
            raw: list[float] = []
            for unpack in unpacks:
                raw += unpack(data, at)
            raw += [read(data, at) for read in reads]
            return tuple([raw[place] for place in places])

        return read_mixed

    def write(self, frame: bytearray, values: Sequence[float]) -> None:
        """Write the numbers of a record into a frame.

        Raises
        ------
        struct.error, ValueError, OverflowError
            A value does not fit into its field, or the number of values is wrong.
        """
        rest = iter([values[at] for at in self._wire_order])
        for each in self._structs:
            mask = bytearray(len(frame))
            count = sum(code != "x" for code in re.findall(r"[a-zA-Z]", each.format))
            each.pack_into(mask, 0, *[next(rest) for _ in range(count)])
            for at, byte in enumerate(mask[: each.size]):
                frame[at] |= byte
        for bit_field in self._bits:
            bit_field.write(frame, int(next(rest)))


class _BitField:
    """An integer that does not fill whole bytes, or for which ``struct`` has no code."""

    def __init__(self, field: TableField) -> None:
        self._field = field
        self._length = field.end - field.offset
        at_end = 8 * self._length - field.bit - field.bits
        self._shift = field.bit if field.byte_order == "little" else at_end
        self._mask = (1 << field.bits) - 1
        self._sign = 1 << (field.bits - 1) if field.kind == "i" else 0
        self.read = self._compile()

    def _compile(self) -> Callable[[bytes, int], int]:
        field, length, shift, mask, sign = (
            self._field, self._length, self._shift, self._mask, self._sign
        )  # fmt: skip
        offset, order = field.offset, field.byte_order

        def read(data: bytes, at: int) -> int:
            first = at + offset
            value = int.from_bytes(data[first : first + length], order) >> shift & mask
            return (value ^ sign) - sign

        return read

    def write(self, frame: bytearray, value: int) -> None:
        low = -self._sign
        if not low <= value <= self._mask + low:
            raise OverflowError(f"{value} does not fit {self._field.kind}{self._field.bits}")
        field = self._field
        place = slice(field.offset, field.end)
        bits = int.from_bytes(frame[place], field.byte_order)
        bits |= (value & self._mask) << self._shift
        frame[place] = bits.to_bytes(self._length, field.byte_order)


def slot_quantities(slots: Iterable[int]) -> tuple[Quantity, ...]:
    """Return the quantities that have a slot in `slots`, in the order of a record."""
    present = set(slots)
    return tuple(name for name, place in SLOTS.items() if present & set(place))


def _is_whole(field: TableField, order: ByteOrder) -> bool:
    """Return whether ``struct`` can read the field with this byte order."""
    if field.bit or (field.kind, field.bits) not in _CODES:
        return False
    return order == (field.byte_order if field.bits > 8 else "little")  # noqa: PLR2004 - one byte


def _by_place(fields: Sequence[TableField]) -> list[int]:
    return sorted(range(len(fields)), key=lambda at: fields[at].offset)


def _format(fields: Sequence[TableField], order: ByteOrder) -> str:
    """Return the ``struct`` format of fields in ascending order, with padding between them."""
    text, at = "<" if order == "little" else ">", 0
    for field in fields:
        text += f"{field.offset - at}x" if field.offset > at else ""
        text += _CODES[field.kind, field.bits]
        at = field.end
    return text
