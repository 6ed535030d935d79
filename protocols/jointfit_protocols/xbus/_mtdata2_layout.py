"""Fast decoding of MTData2 messages whose items are the same as in an earlier message.

A device sends the same configured items in every message. The item heads of one message therefore
determine the position of every value in the next message. A message with a different head has a
different layout.

Invariant: the result equals the result of `split` and `decode_item`, or is None.
"""

from __future__ import annotations

import struct
from operator import itemgetter
from typing import TYPE_CHECKING

from jointfit_protocols.xbus.mtdata2 import COUNT_BYTES, Item, Precision, reals_in

if TYPE_CHECKING:
    from collections.abc import Container, Sequence

    from jointfit_protocols.xbus.mtdata2 import Value

_COUNT_CODES = {1: "B", 2: "H", 4: "I"}
_HEAD = 2
"""Number of values in the head of an item: identifier and size."""


class MTData2Layout:
    """Positions of the requested items in a message.

    Parameters
    ----------
    items : sequence of (int, bytes)
        Items of a message, as returned by `split`. `decode_item` must be able to decode the
        requested items.
    wanted : container of int
        Identifiers to decode, with precision and world bits set to zero.
    """

    __slots__ = ("_heads", "_many", "_one", "_read_heads", "_struct", "world_id")

    def __init__(self, items: Sequence[tuple[int, bytes]], wanted: Container[int]) -> None:
        written, heads, places = ">", list[int](), list[int]()
        self._one: list[tuple[int, int]] = []
        self._many: list[tuple[int, slice]] = []
        self.world_id = 0
        """Identifier of the last quaternion. Two of its bits encode the world frame."""
        at = 0

        for data_id, raw in items:
            kind = data_id & 0xFFF0
            heads += (data_id, len(raw))
            places += (at, at + 1)
            at += _HEAD

            count, form = _form(data_id, raw) if kind in wanted else (1, f"{len(raw)}s")
            if kind in wanted and count == 1:
                self._one.append((kind, at))
            elif kind in wanted:
                self._many.append((kind, slice(at, at + count)))
            written += f"HB{form}"
            at += count
            self.world_id = data_id if kind == Item.QUATERNION else self.world_id

        self._struct = struct.Struct(written)
        self._heads, self._read_heads = tuple(heads), itemgetter(*places)

    @staticmethod
    def of(items: Sequence[tuple[int, bytes]], wanted: Container[int]) -> MTData2Layout | None:
        """Return the layout of the items; None if a wanted item has no struct code.

        The result is also None if there are no items.
        """
        plain = all(
            data_id & 0xFFF0 not in wanted or _form(data_id, raw)[0] for data_id, raw in items
        )
        return MTData2Layout(items, wanted) if items and plain else None

    def read(self, data: bytes) -> dict[int, Value] | None:
        """Return the requested items by identifier; None for a message with a different layout."""
        if len(data) != self._struct.size:
            return None

        found = self._struct.unpack(data)
        if self._read_heads(found) != self._heads:
            return None

        values: dict[int, Value] = {kind: found[at] for kind, at in self._one}
        for kind, places in self._many:
            values[kind] = found[places]
        return values


def _form(data_id: int, raw: bytes) -> tuple[int, str]:
    """Return an item's number of values and their struct code; 0 values without a struct code."""
    if data_id in COUNT_BYTES:
        return 1, _COUNT_CODES[len(raw)]
    count = reals_in(data_id)
    if count is None or data_id & 0x3 != Precision.FLOAT32:
        return 0, ""
    return count, f"{count}f"
