"""Numbers and names in the sync settings of an Xbus device: functions, lines, polarities.

An entry of the synchronisation settings (`configuration.SyncSetting`) assigns a function to a line.
An edge on an input with the function ``trigger_indication`` is reported in the next MTData2
message. The output configuration must contain the item TriggerIn1 or TriggerIn2:

    | line U1 | polarity U1 | time U4, ticks of SampleTimeFine | frame U2 |

U1, U2 and U4 are unsigned integers of 1, 2 and 4 bytes. The number of the output line is 7 for the
MTi-600 series, and 4 for all other series.

Source: MT0101P rev. 2020.A. The layout of the item is from the vendor's public headers. These
sources do not document the unit of the item's time, which is assumed to be the unit of
SampleTimeFine.
"""

from __future__ import annotations

import re
from enum import IntEnum


class SyncFunction(IntEnum):
    """Function of a sync line."""

    TRIGGER_INDICATION = 3
    """Input function: an edge is reported, and bit 21 of the next status word is set."""
    INTERVAL_TRANSITION_MEASUREMENT = 4
    """Output function: a pulse is sent with every sample."""
    SEND_LATEST = 8
    """Input function: an edge requests the newest sample."""
    CLOCK_BIAS_ESTIMATION = 9
    """Input function: edges with a known period synchronize the device's clock."""
    START_SAMPLING = 11
    """Input function: an edge starts sampling."""
    GNSS_1PPS = 14
    """Input function: the line receives the pulse per second of a GNSS receiver."""


class Polarity(IntEnum):
    """Edges that are used."""

    RISING = 1
    FALLING = 2
    BOTH = 3


CLOCK_IN, IN1, IN2 = 0, 2, 9
_OUT, _OUT_600 = 4, 7
_SERIES_600 = 600
LINES = ("clock_in", "in1", "in2", "out1")
"""Names of the lines in the data sheets of the devices."""


def line_code(name: str, product_code: str) -> int:
    """Return the number of a line on a device with this product code.

    Raises
    ------
    KeyError
        No line has this name.
    """
    model = re.search(r"MTi-(?:G-)?(\d+)", product_code)
    late = model is not None and _SERIES_600 <= int(model[1]) < _SERIES_600 + 100
    return {"clock_in": CLOCK_IN, "in1": IN1, "in2": IN2, "out1": _OUT_600 if late else _OUT}[name]


def line_name(code: int) -> str:
    """Return the name of a line, or its number if it has none."""
    names = {CLOCK_IN: "clock_in", IN1: "in1", IN2: "in2", _OUT: "out1", _OUT_600: "out1"}
    return names.get(code, f"line {code}")


def function_name(code: int) -> str:
    """Return the name of a function, or its number if it has none."""
    known = code in set(SyncFunction)
    return SyncFunction(code).name.lower() if known else f"function {code}"


def polarity_name(code: int) -> str:
    """Return the name of a polarity, ``off``, or its number if it has none."""
    if code in set(Polarity):
        return Polarity(code).name.lower()
    return "off" if code == 0 else f"polarity {code}"
