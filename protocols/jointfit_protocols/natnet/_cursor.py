"""A bounded reading position in one NatNet payload.

Data that contradict the layout raise `MalformedError`, or `struct.error` with the same meaning. The
outer functions of the codec convert both to `CorruptBytes`, so neither exception leaves the
package.

Invariant: no read goes beyond the end. A count is used only if enough bytes remain for it.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_NAME = 255
"""Longest accepted name, bytes. Names of real servers have less than 64 bytes."""

I32 = struct.Struct("<i")
XYZ = struct.Struct("<3f")

BREAKS = (ValueError, struct.error)
"""Exceptions that reading a malformed payload may raise (`MalformedError` is a ValueError)."""


class MalformedError(ValueError):
    """The payload contradicts the layout of its bitstream version."""


class Cursor:
    """A reading position in ``data``, which advances from ``at`` to ``end``.

    Parameters
    ----------
    data : bytes
        The complete datagram.
    at : int
        Offset of the first payload byte.
    """

    __slots__ = ("at", "data", "end")

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data = data
        self.at = at
        self.end = len(data)

    @property
    def left(self) -> int:
        """Number of remaining bytes."""
        return self.end - self.at

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read one record of `layout`."""
        at = self.at
        after = at + layout.size
        if after > self.end:
            raise MalformedError("ends inside a record")
        self.at = after
        return layout.unpack_from(self.data, at)

    def integer(self) -> int:
        """Read one little-endian int32."""
        value: int = self.unpack(I32)[0]
        return value

    def count(self, smallest: int) -> int:
        """Read the number of items with at least `smallest` bytes each, and check it."""
        n = self.integer()
        self.check(n, smallest)
        return n

    def check(self, n: int, smallest: int) -> None:
        """Reject a count that is negative or for which not enough bytes remain."""
        if n < 0 or n * smallest > self.end - self.at:
            raise MalformedError("a count exceeds the datagram")

    def records(self, layout: struct.Struct, n: int) -> list[tuple[Any, ...]]:
        """Check `n`, and read `n` records of `layout`."""
        if not n:
            return []
        self.check(n, layout.size)
        at = self.at
        self.at = at + n * layout.size
        return list(layout.iter_unpack(self.data[at : self.at]))

    def text(self) -> str:
        """Read a NUL-terminated name of at most 255 bytes; invalid UTF-8 is replaced."""
        stop = self.data.find(0, self.at, min(self.end, self.at + MAX_NAME + 1))
        if stop < 0:
            raise MalformedError("a name without an end")

        found = self.data[self.at : stop]
        self.at = stop + 1
        return found.decode("utf-8", "replace")

    def texts(self) -> tuple[str, ...]:
        """Read a count, then as many names as the count states."""
        return tuple(self.text() for _ in range(self.count(1)))

    def window(self, size: int, read: Callable[[], Any]) -> Any:
        """Call `read` for the next `size` bytes, and continue after these bytes in any case.

        Return None if `read` failed or did not use all bytes. An unknown or malformed section is
        skipped in this way. If fewer than `size` bytes remain, raise `MalformedError`.
        """
        if size < 0 or size > self.left:
            raise MalformedError("a section exceeds the datagram")

        outer, self.end = self.end, self.at + size
        try:
            found = read()
        except BREAKS:
            return None
        else:
            return found if self.at == self.end else None
        finally:
            self.at, self.end = self.end, outer


def put_text(name: str) -> bytes:
    """Return `name` as NUL-terminated UTF-8.

    Raises
    ------
    ValueError
        The name contains a NUL or exceeds 255 bytes.
    """
    data = name.encode("utf-8")
    if 0 in data or len(data) > MAX_NAME:
        raise ValueError(f"a NatNet name is at most {MAX_NAME} bytes without NUL, not {name!r}")
    return data + b"\0"


def put_texts(names: tuple[str, ...]) -> bytes:
    """Return the number of names, followed by the NUL-terminated names."""
    return I32.pack(len(names)) + b"".join(map(put_text, names))


def put_fixed_text(name: str, size: int) -> bytes:
    """Return `name` in a field of `size` bytes, padded with at least one NUL.

    Raises
    ------
    ValueError
        The name does not fit.
    """
    data = put_text(name)
    if len(data) > size:
        raise ValueError(f"{name!r} does not fit into {size} bytes")
    return data.ljust(size, b"\0")


def fixed_text(field: bytes) -> str:
    """Return the name in a field of fixed size, up to the first NUL.

    Old data may follow the NUL.
    """
    return field.partition(b"\0")[0].decode("utf-8", "replace")
