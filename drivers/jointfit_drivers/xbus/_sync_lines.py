"""Sync lines of an Xbus device: conversion of rig.toml to the entries that the device stores.

The order of entries does not matter to the device, and is ignored in comparisons.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field
from typing_extensions import override  # typing contains it from Python 3.12

from jointfit_daemon.driver import Settings
from jointfit_protocols.xbus.configuration import SyncSetting
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.xbus.sync_lines import (
    Polarity,
    SyncFunction,
    function_name,
    line_code,
    line_name,
    polarity_name,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

_MOST = 0xFFFF
"""Largest value of a 16-bit field."""
_UNITS_PER_MS = 10
"""Number of units of pulse width and delay (100 us) in a millisecond."""
TRIGGERS = {"in1": Item.TRIGGER_IN1, "in2": Item.TRIGGER_IN2}
"""Data item that reports the edges of each line."""

Function = Literal[
    "trigger_indication",
    "interval_transition_measurement",
    "send_latest",
    "clock_bias_estimation",
    "start_sampling",
    "gnss_1pps",
]


class XbusSyncSettings(Settings):
    """Function of one sync line of one device."""

    function: Function = Field(
        description="`trigger_indication` (reports edges), `clock_bias_estimation` (edges every "
        "`period_ms` synchronize the device clock), `start_sampling`, `send_latest`, `gnss_1pps`; "
        "on an output `interval_transition_measurement` (one pulse per sample)"
    )
    line: Literal["clock_in", "in1", "in2", "out1"] = Field(description="line of the device")
    polarity: Literal["rising", "falling", "both"] = Field(
        "rising", description="edge that is used"
    )
    once: bool = Field(False, description="use only the first edge")
    skip_first: int = Field(0, ge=0, le=_MOST, description="number of edges ignored at the start")
    skip_factor: int = Field(
        0, ge=0, le=_MOST, description="number of edges ignored between two used edges"
    )
    pulse_width_ms: float = Field(
        0.0, ge=0, le=6553.5, description="width of the pulses on an output, ms, in steps of 0.1"
    )
    delay_ms: float = Field(
        0.0, ge=0, le=6553.5, description="delay from the edge to the action, ms, in steps of 0.1"
    )
    period_ms: int = Field(
        0,
        ge=0,
        le=_MOST,
        description="period of the reference edges of `clock_bias_estimation`, ms",
    )
    wire: int = Field(
        0,
        ge=0,
        description="number of the wire in the rig: devices on one wire have the same number",
    )

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield combinations of settings that no device supports."""
        function: str | None = self.function  # None: key cannot be read
        if function is None:
            return
        line: str | None = self.line
        out = function == "interval_transition_measurement"
        if line is not None and out != (line == "out1"):
            kind = "an output (out1)" if out else "an input (clock_in, in1, in2)"
            yield "line", f"{function} is a function of {kind}"
        elif function == "trigger_indication" and line not in {None, *TRIGGERS}:
            yield "line", "expected in1 or in2 with trigger_indication"

        period_ms: int | None = self.period_ms
        if period_ms is not None and (function == "clock_bias_estimation") != (period_ms > 0):
            yield "period_ms", "belongs to clock_bias_estimation, which needs it"


def sync_entries(
    settings: Iterable[XbusSyncSettings], product_code: str
) -> tuple[SyncSetting, ...]:
    """Return the entries of `settings` for a device of this product code."""
    return tuple(
        SyncSetting(
            SyncFunction[one.function.upper()],
            line_code(one.line, product_code),
            Polarity[one.polarity.upper()],
            int(one.once),
            one.skip_first,
            one.skip_factor,
            round(one.pulse_width_ms * _UNITS_PER_MS),
            one.period_ms or round(one.delay_ms * _UNITS_PER_MS),
        )
        for one in settings
    )


def sync_differences(found: Sequence[SyncSetting], asked: Sequence[SyncSetting]) -> list[str]:
    """Return the entries that the device lacks, and the entries that were not requested."""
    lacks = [f"it does not have {describe_entry(one)}" for one in asked if one not in found]
    return lacks + [f"it has {describe_entry(one)}" for one in found if one not in asked]


def describe_entry(one: SyncSetting) -> str:
    """Return a description of an entry."""
    words = [
        function_name(one.function),
        "on",
        line_name(one.line),
        polarity_name(one.polarity),
    ]
    more = {
        "once": one.once,
        "skip_first": one.skip_first,
        "skip_factor": one.skip_factor,
        "pulse_width_ms": one.pulse_width / _UNITS_PER_MS,
    }
    clocked = one.function == SyncFunction.CLOCK_BIAS_ESTIMATION

    more |= {"period_ms": one.delay} if clocked else {"delay_ms": one.delay / _UNITS_PER_MS}
    return " ".join([*words, *(f"{name} {value:g}" for name, value in more.items() if value)])


def trigger_wires(settings: Iterable[XbusSyncSettings]) -> dict[int, int]:
    """Return the number of the rig's sync wire for every data item that reports edges."""
    return {
        int(TRIGGERS[one.line]): one.wire
        for one in settings
        if one.function == "trigger_indication"
    }
