"""Records of a device that a table describes, and the meaning of their numbers."""

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
    """Meaning of the numbers of a record."""

    slots: tuple[int, ...]
    """Slots of the record, in its order."""
    scales: tuple[float, ...]
    """SI value of one count of each measured component."""
    zeros: tuple[float, ...]
    """SI value of the count 0 of each measured component."""
    rate_hz: float
    tick_clock: TickClock | None = None
    """Unit and modulus of device time; None without device time."""
    ticks_per_count: float | None = None
    """Ticks per unit of a time that is no integer; None if the integer counts ticks."""
    counts: int | None = None
    """Values of the counter; None: it never wraps."""
    mask: int = -1
    """Bits of the number of validity that are evaluated."""
    equals: int | None = None
    """Value of these bits in a valid sample; None: any but 0."""
    world: World = "ENU"
    world_to_sensor: bool = False
    fields: Mapping[int, TableField] | None = None
    """Place of each slot, to find settings that fit; None for text lines."""
    rate_unit: float = 1.0
    """SI value of the configured unit of angular rates."""
    make_raw: Callable[[], RawSamples] | None = None
    """Function that returns a new filter of raw measurements; None if the device sends
    orientations."""


class TableRecord(NamedTuple):
    """One record with its arrival."""

    arrival_ns: int
    values: tuple[float | None, ...]
    """Numbers as sent, in the order of the slots; None if a frame is missing."""
    size: int
    """Length of the record on the wire, or in the chunks of a CAN bus, bytes."""
    data: tuple[bytes, ...]
    """Data of its frames."""


def duration_ns(clock: TickClock | None) -> float:
    """Return the duration of a tick, ns; 1 without device time."""
    if clock is None:
        return 1.0
    return 1e9 / clock.ticks_per_s if clock.ticks_per_s else float(clock.tick_ns)
