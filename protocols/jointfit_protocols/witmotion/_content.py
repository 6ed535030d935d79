"""Content of WitMotion frames, in both directions: little-endian int16, and a calendar time.

| kind            | content                                    | unit of a count           |
|-----------------|--------------------------------------------|---------------------------|
| 0x50            | YY MM DD hh mm ss, ms (uint16)             |                           |
| 0x51            | acceleration x y z, temperature            | 16 g / 32768              |
| 0x52            | angular rate x y z, voltage or temperature | 2000 degrees/s / 32768    |
| 0x54            | magnetic field x y z, temperature          | differs between models    |
| 0x59            | quaternion w x y z                         | 1 / 32768                 |
| 0x5F            | four registers                             |                           |

Source: protocol pages of the vendor, which use g = 9.8 m/s^2.
"""

from __future__ import annotations

import struct
from math import radians

FULL_SCALE = 32768
"""Number of counts for 1 in a quaternion. The identity is sent as 32767."""
TICK_NS = 1_000_000
"""Unit of the calendar time, ns."""
G = 9.8
"""Acceleration of gravity that the vendor uses for the conversion of counts, m/s^2."""

_COUNTS = struct.Struct("<4h")
_REGISTERS = struct.Struct("<4H")
_TIME = struct.Struct("<6BH")
_FORCE = 16.0 * G / FULL_SCALE
"""Acceleration of one count, m/s^2."""
_RATE = radians(2000.0) / FULL_SCALE
"""Angular rate of one count, rad/s."""
_MONTHS, _DAYS, _HOURS, _SIXTIETHS, _MILLISECONDS = 12, 31, 24, 60, 1000
_YEAR_DAYS = (0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334)
"""Number of days in a year before each month, without the leap day."""
_FEBRUARY = 2


def counts_of(data: bytes) -> tuple[int, int, int, int]:
    """Return the four int16 numbers in the data of a frame."""
    w, x, y, z = _COUNTS.unpack(data)
    return w, x, y, z


def encode_counts(counts: tuple[int, int, int, int]) -> bytes:
    """Return the data of a frame with four int16 numbers. Larger values are clipped."""
    return _COUNTS.pack(*(max(-FULL_SCALE, min(FULL_SCALE - 1, count)) for count in counts))


def acceleration_of(data: bytes) -> tuple[float, float, float]:
    """Return the specific force in a frame 0x51, m/s^2."""
    x, y, z, _ = _COUNTS.unpack(data)
    return _FORCE * x, _FORCE * y, _FORCE * z


def rate_of(data: bytes) -> tuple[float, float, float]:
    """Return the angular rate in a frame 0x52, rad/s."""
    x, y, z, _ = _COUNTS.unpack(data)
    return _RATE * x, _RATE * y, _RATE * z


def registers_of(data: bytes) -> tuple[int, int, int, int]:
    """Return the four registers in a frame 0x5F, beginning with the requested register."""
    a, b, c, d = _REGISTERS.unpack(data)
    return a, b, c, d


def time_of(data: bytes) -> int | None:
    """Return the time in a frame 0x50, ms since the start of 2000; None if it is not a valid time.

    If a clock was never set, its month 0 and day 0 count as 1.
    """
    year, month, day, hour, minute, second, milli = _TIME.unpack(data)
    month, day = month or 1, day or 1
    if month > _MONTHS or day > _DAYS or hour >= _HOURS:
        return None
    if minute >= _SIXTIETHS or second >= _SIXTIETHS or milli >= _MILLISECONDS:
        return None

    # 2000 is a leap year, and 2100 is out of range.
    days = 365 * year + (year + 3) // 4 + _YEAR_DAYS[month - 1] + day - 1
    days += year % 4 == 0 and month > _FEBRUARY
    ticks: int = (((days * 24 + hour) * 60 + minute) * 60 + second) * 1000 + milli
    return ticks


def encode_time(ticks: int) -> bytes:
    """Return the data of a frame 0x50 for a time before 2100, ms since the start of 2000."""
    seconds, milli = divmod(ticks, 1000)
    minutes, second = divmod(seconds, 60)
    hours, minute = divmod(minutes, 60)
    days, hour = divmod(hours, 24)

    cycles, days = divmod(days, 1461)  # four years, the first one with a leap day
    year = max(0, days - 1) // 365
    days -= 365 * year + (year > 0)
    leap = year == 0
    starts = [start + (leap and month > 1) for month, start in enumerate(_YEAR_DAYS)]
    month = max(month for month, start in enumerate(starts) if start <= days)
    date = (4 * cycles + year, month + 1, days - starts[month] + 1)
    return _TIME.pack(*date, hour, minute, second, milli)
