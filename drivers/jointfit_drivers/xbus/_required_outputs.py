"""Which outputs an Xbus device must have, by what its orientation is made of.

Law: a table. Any item of a need will do; the first is what is asked for. Increments (DeltaQ,
DeltaV) serve as well as rates where the device is set to them already.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from jointfit_protocols.xbus.mtdata2 import Item, reals_in

_FRAME_BYTES = 5 + 5 + 7  # frame, packet counter, time
_ITEM_HEAD, _FLOAT = 3, 4


class Need(NamedTuple):
    """One kind of output."""

    items: tuple[Item, ...]
    one: str
    many: str


ORIENTATION = (Need((Item.QUATERNION,), "quaternion", "quaternions"),)
_FELT = (
    Need((Item.RATE_OF_TURN, Item.DELTA_Q), "rate of turn", "rates of turn"),
    Need((Item.ACCELERATION, Item.DELTA_V), "acceleration", "accelerations"),
)
_FIELD = Need((Item.MAGNETIC_FIELD,), "magnetic field", "magnetic fields")


class OrientationSettings(Protocol):
    """The keys of a device's table that decide which outputs it needs."""

    @property
    def orientation(self) -> str:
        """``device`` or ``gateway``."""

    @property
    def magnetometer(self) -> bool:
        """Whether the gateway reads it."""


def needs_of(settings: OrientationSettings) -> tuple[Need, ...]:
    """Return what a device with these settings must send."""
    if settings.orientation == "device":
        return ORIENTATION
    return (*_FELT, _FIELD) if settings.magnetometer else _FELT


def message_bytes(needs: tuple[Need, ...]) -> int:
    """Return the size of the smallest message that will do, floats of 32 bit."""
    reals = [reals_in(need.items[0]) or 0 for need in needs]
    return _FRAME_BYTES + sum(_ITEM_HEAD + _FLOAT * count for count in reals)
