"""Checksums of frames, described by parameters: sums, XOR, Fletcher and CRC.

| kind       | value                                                                       |
|------------|-----------------------------------------------------------------------------|
| sum8       | (init + sum of all bytes) mod 256; sum16: mod 65536                         |
| xor8       | init XOR all bytes                                                          |
| fletcher16 | a = a + byte, b = b + a, both modulo `modulus`; first a, then b             |
| crc8       | CRC with polynomial, init and reflection; the same for crc16 and crc32      |

`xor_out` is combined with the result by XOR. The parameters of a CRC have the meanings of the
catalogue of parametrised CRC algorithms. If the checksum is the two's complement of the sum, init
and xor_out are 0xFF for sum8, and 0xFFFF for sum16.

Invariant: the checksums are pure functions of bytes. Parameters are compiled only once.
"""

from __future__ import annotations

from binascii import crc32, crc_hqx
from functools import reduce
from itertools import accumulate
from operator import xor
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_protocols.table._fields import ByteOrder

ChecksumKind = Literal["sum8", "sum16", "xor8", "fletcher16", "crc8", "crc16", "crc32"]

WIDTHS: dict[ChecksumKind, int] = {
    "sum8": 1, "sum16": 2, "xor8": 1, "fletcher16": 2, "crc8": 1, "crc16": 2, "crc32": 4,
}  # fmt: skip
"""Length of each type of checksum, bytes."""
_CCITT = 0x1021
"""Polynomial of the CRC-16 for which the standard library has a function."""
_CRC32 = 0x04C11DB7
_POLYNOMIALS = {"crc8": 0x07, "crc16": _CCITT, "crc32": _CRC32}
_BYTE = 8


class Checksum(NamedTuple):
    """Parameters of a checksum."""

    kind: ChecksumKind
    first: int = 0
    """Index of the first byte of the frame that the checksum includes. The last included byte is
    the byte before the checksum."""
    byte_order: ByteOrder = "little"
    """Byte order of the checksum in the frame. For fletcher16, ``little`` means that the plain sum
    is first."""
    polynomial: int | None = None
    """CRC polynomial without the highest bit, not reflected. None selects 0x07, 0x1021 or
    0x04C11DB7, depending on the kind."""
    init: int = 0
    reflected: bool = False
    """Whether the CRC processes each byte from its least significant bit on."""
    xor_out: int = 0
    modulus: int = 256
    """Modulus of fletcher16, 256 or 255."""

    @property
    def width(self) -> int:
        """Length of the checksum, bytes."""
        return WIDTHS[self.kind]


def compile_checksum(checksum: Checksum) -> Callable[[bytes], int]:
    """Return a function that computes the checksum of the included bytes."""
    kind, init, xor_out = checksum.kind, checksum.init, checksum.xor_out
    if kind == "sum8":
        return lambda data: (sum(data) + init) & 0xFF ^ xor_out
    if kind == "sum16":
        return lambda data: (sum(data) + init) & 0xFFFF ^ xor_out
    if kind == "xor8":
        return lambda data: reduce(xor, data, init) ^ xor_out
    if kind == "fletcher16":
        return _fletcher(checksum.modulus, init, xor_out)
    return _compile_crc(checksum)


def _fletcher(modulus: int, init: int, xor_out: int) -> Callable[[bytes], int]:
    first, second = init & 0xFF, init >> _BYTE

    def compute(data: bytes) -> int:
        plain = (first + sum(data)) % modulus
        # Every partial sum includes the initial value.
        weighted = (second + sum(accumulate(data)) + len(data) * first) % modulus
        return (weighted << _BYTE | plain) ^ xor_out

    return compute


def _compile_crc(checksum: Checksum) -> Callable[[bytes], int]:
    width, init, xor_out = 8 * checksum.width, checksum.init, checksum.xor_out
    polynomial = checksum.polynomial
    if polynomial is None:
        polynomial = _POLYNOMIALS[checksum.kind]
    if polynomial == _CCITT and not checksum.reflected and checksum.kind == "crc16":
        return lambda data: crc_hqx(data, init) ^ xor_out
    if polynomial == _CRC32 and checksum.reflected:  # zlib inverts before and after
        start, inverted = _reflect(init, width) ^ 0xFFFFFFFF, xor_out ^ 0xFFFFFFFF
        return lambda data: crc32(data, start) ^ inverted

    if checksum.reflected:
        table = tuple(_reflected_entry(byte, _reflect(polynomial, width)) for byte in range(256))
        start = _reflect(init, width)

        def compute_reflected(data: bytes) -> int:
            crc = start
            for byte in data:
                crc = crc >> _BYTE ^ table[crc & 0xFF ^ byte]
            return crc ^ xor_out

        return compute_reflected

    table = tuple(_entry(byte, polynomial, width) for byte in range(256))
    mask, high = (1 << width) - 1, width - _BYTE

    def compute(data: bytes) -> int:
        crc = init
        for byte in data:
            crc = crc << _BYTE & mask ^ table[crc >> high ^ byte]
        return crc ^ xor_out

    return compute


def _entry(byte: int, polynomial: int, width: int) -> int:
    """Return the remainder of one byte, which is an entry of the CRC table."""
    crc, top, mask = byte << (width - _BYTE), 1 << (width - 1), (1 << width) - 1
    for _ in range(_BYTE):
        crc = (crc << 1 ^ polynomial if crc & top else crc << 1) & mask
    return crc


def _reflected_entry(byte: int, polynomial: int) -> int:
    crc = byte
    for _ in range(_BYTE):
        crc = crc >> 1 ^ polynomial if crc & 1 else crc >> 1
    return crc


def _reflect(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)
