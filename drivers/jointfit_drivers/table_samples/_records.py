"""Records of a device that a table describes, and the meaning of the numbers in them.

A *slot* is the index of one component of one quantity (`jointfit_protocols.table.SLOTS`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from typing import NamedTuple

from jointfit_daemon.model import TickClock  # noqa: TC001 - mypyc evaluates the types of fields
from jointfit_drivers.gateway_orientation import (
    RawSamples,  # noqa: TC001 - mypyc evaluates the types of fields
)
from jointfit_protocols.orientation import World  # noqa: TC001 - mypyc evaluates the types of fields
from jointfit_protocols.table import TableField  # noqa: TC001 - mypyc evaluates the types of fields


class SampleForm(NamedTuple):
    """Meaning of the numbers in a record."""

    slots: tuple[int, ...]
    """Slots of the record in the order of its numbers."""
    scales: tuple[float, ...]
    """SI value of one count, for each measured component."""
    zeros: tuple[float, ...]
    """SI value of the count 0, for each measured component."""
    rate_hz: float
    tick_clock: TickClock | None = None
    """Unit and modulus of device time; None if the device sends no time."""
    ticks_per_count: float | None = None
    """Number of ticks per unit of a time that is not an integer; None if the time is in ticks."""
    counts: int | None = None
    """Number of values of the counter; None if it never wraps."""
    mask: int = -1
    """Mask of the bits in the validity number that are evaluated."""
    equals: int | None = None
    """Value of the masked bits in a valid sample; None if any value except 0 is valid."""
    world: World = "ENU"
    world_to_sensor: bool = False
    fields: Mapping[int, TableField] | None = None
    """Position of each slot, for the search for settings that fit; None for text lines."""
    rate_unit: float = 1.0
    """SI value of the configured unit of angular rates."""
    make_raw: Callable[[], RawSamples] | None = None
    """Function that returns a new filter of raw measurements; None if the device sends
    orientations."""


class TableRecord(NamedTuple):
    """One record and its arrival."""

    arrival_ns: int
    values: tuple[float | None, ...]
    """Numbers as sent, in the order of the slots; None if their frame is missing."""
    size: int
    """Length of the record, bytes: on the wire, or in the chunks of a CAN bus."""
    data: tuple[bytes, ...]
    """Bytes of the frames of the record."""


def duration_ns(clock: TickClock | None) -> float:
    """Return the duration of a tick, ns; 1 if there is no device time."""
    if clock is None:
        return 1.0
    return 1e9 / clock.ticks_per_s if clock.ticks_per_s else float(clock.tick_ns)
