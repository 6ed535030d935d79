"""Names of the functions of an Xbus device's sync lines.

An entry of the synchronisation settings (`configuration.SyncSetting`) assigns a function to a line.
An edge on an input with the function ``trigger_indication`` is reported in the next MTData2, item
TriggerIn1 or TriggerIn2, if the output configuration contains it:

    | line U1 | polarity U1 | time U4, ticks of SampleTimeFine | frame U2 |

The number of the output line depends on the series: 4, and 7 from the MTi-600 on.

Source: MT0101P rev. 2020.A; layout of the item from the vendor's public headers. These sources do
not document the unit of its time.
"""

from __future__ import annotations

import re
from enum import IntEnum


class SyncFunction(IntEnum):
    """Function of a line."""

    TRIGGER_INDICATION = 3
    """Input: an edge is reported, and bit 21 of the next status word is set."""
    INTERVAL_TRANSITION_MEASUREMENT = 4
    """Output: a pulse with every sample."""
    SEND_LATEST = 8
    """Input: an edge requests the newest sample."""
    CLOCK_BIAS_ESTIMATION = 9
    """Input: edges of a known period discipline the device's clock."""
    START_SAMPLING = 11
    """Input: an edge starts the sampling."""
    GNSS_1PPS = 14
    """Input: the pulse of a GNSS receiver."""


class Polarity(IntEnum):
    """Edge that counts."""

    RISING = 1
    FALLING = 2
    BOTH = 3


CLOCK_IN, IN1, IN2 = 0, 2, 9
_OUT, _OUT_600 = 4, 7
_SERIES_600 = 600
LINES = ("clock_in", "in1", "in2", "out1")
"""Names of the lines, as printed on the devices' data sheets."""


def line_code(name: str, product_code: str) -> int:
    """Return the number of a line on a device with this product code.

    Raises
    ------
    KeyError
        There is no line of that name.
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
