"""Random changes of inputs: bytes, numbers, repeated, cut and mixed parts."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

_INTEGERS = tuple(
    value.to_bytes(size, order)
    for size in (1, 2, 4, 8)
    for value in (0, 1, (1 << 8 * size - 1) - 1, 1 << 8 * size - 1, (1 << 8 * size) - 1)
    for order in ("little", "big")
)
_FLOATS = tuple(
    struct.pack(layout, value) for layout in ("<f", ">f") for value in (math.inf, math.nan, 3e38)
)
_TEXTS = (b"nan", b"inf", b"-1", b"1e999", b"9" * 20, b"[[", b"\0")
NUMBERS = (*_INTEGERS, *_FLOATS, *_TEXTS)
"""Limits of integers, infinite and undefined floats, and similar numbers as text."""
MOST_CHANGES = 4


def mutate(corpus: Sequence[bytes], dice: random.Random, longest: int) -> bytes:
    """Return an input of `corpus` with up to `MOST_CHANGES` changes, at most `longest` bytes.

    Parameters
    ----------
    corpus : sequence of bytes
        At least one input.
    dice : random.Random
        Source of the changes.
    longest : int
        Largest result, bytes.
    """
    draw = dice.random
    data = bytearray(corpus[int(draw() * len(corpus))])
    for _ in range(1 + int(draw() * MOST_CHANGES)):
        size = len(data)
        at, kind = int(draw() * (size + 1)), int(draw() * 8)
        if kind == 0 and at < size:
            data[at] ^= 1 << int(draw() * 8)
        elif kind <= 2 and at < size:
            data[at] = int(draw() * 256)
        elif kind == 3:
            number = NUMBERS[int(draw() * len(NUMBERS))]
            data[at : at + len(number)] = number
        elif kind == 4:
            data[at:at] = NUMBERS[int(draw() * len(NUMBERS))]
        elif kind == 5:
            # Short parts are removed more often than long ones.
            del data[at : at + 1 + int(draw() ** 3 * size)]
        elif kind == 6:
            end = at + 1 + int(draw() ** 2 * (size - at))
            data[at:at] = data[at:end]
        else:
            other = corpus[int(draw() * len(corpus))]
            data[at:] = other[int(draw() * (len(other) + 1)) :]
    return bytes(data[:longest])
