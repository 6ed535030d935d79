"""Registers of VectorNav devices that a driver reads and writes.

| register | content                                                                       |
|----------|-------------------------------------------------------------------------------|
| 1, 3, 4  | model, serial number, firmware version                                        |
| 5        | baud rate of the port                                                         |
| 6        | type of the asynchronous ASCII output; 0: off                                 |
| 7        | rate of the asynchronous ASCII output, Hz                                     |
| 26       | reference frame rotation, 3 x 3, row by row: sensor to body axes              |
| 75 to 77 | binary outputs 1 to 3: ports, divisor, groups, fields of each group           |

Written values are valid until power-down, unless the command VNWNV stores all registers.

Source: VN-100 user manual (UM001), section 6.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.vectornav._layout import BinaryLayout, header_bytes, layout_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_protocols.vectornav._layout import Fields


class Register(IntEnum):
    """Numbers of registers."""

    MODEL = 1
    SERIAL = 3
    FIRMWARE = 4
    BAUD = 5
    TEXT_OUTPUT = 6
    TEXT_RATE = 7
    QUATERNION = 9
    ROTATION = 26
    BINARY_OUTPUT = 75


BOTH_PORTS = 3
"""Value that selects both ports of a binary output. 0 is no port, 1 the first, 2 the second
port."""
_MATRIX_VALUES = 9


class BinaryOutput(NamedTuple):
    """Content of a register that configures a binary output."""

    ports: int
    divisor: int
    """Rate of the IMU divided by the rate of the output."""
    fields: Fields


def encode_output(output: BinaryOutput) -> str:
    """Return the values of the register, without its number.

    Raises
    ------
    KeyError
        A field is unknown.
    """
    header = BinaryLayout(output.fields).header
    at = _group_bytes(header)
    groups = ",".join(f"{byte:02X}" for byte in header[:at])
    words = (header[k : k + 2] for k in range(at, len(header), 2))
    fields = ",".join(f"{int.from_bytes(word, 'little'):04X}" for word in words)
    return f"{output.ports},{output.divisor},{groups},{fields}"


def decode_output(values: Sequence[str]) -> BinaryOutput | None:
    """Return the content of the register; None if it is malformed or has unknown fields."""
    try:
        ports, divisor = int(values[0]), int(values[1])
        numbers = [int(value, 16) for value in values[2:]]
        count = _group_bytes(numbers)
        header = bytes(numbers[:count])
        header += b"".join(number.to_bytes(2, "little") for number in numbers[count:])
    except (ValueError, IndexError, OverflowError):
        return None
    if numbers[0] == 0:
        return BinaryOutput(ports, divisor, ())
    size = header_bytes(header, 0)
    layout = layout_of(header[:size]) if size else None
    return None if layout is None else BinaryOutput(ports, divisor, layout.fields)


def _group_bytes(header: Sequence[int]) -> int:
    """Return the number of group bytes; bit 7 of the first byte announces a second byte."""
    return 1 + (header[0] >> 7 & 1)


def decode_rotation(values: Sequence[str]) -> tuple[float, ...] | None:
    """Return the nine elements of a rotation, row by row; None if they are malformed."""
    if len(values) < _MATRIX_VALUES:
        return None
    try:
        return tuple(map(float, values[:_MATRIX_VALUES]))
    except ValueError:
        return None
