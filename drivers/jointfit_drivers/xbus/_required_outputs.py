"""Outputs that an Xbus device must send, which depend on the source of the orientation.

A `RequiredOutput` lists alternative data items, one of which the device must send. If the device
sends none of them, the driver requests the first. Increments (DeltaQ, DeltaV) are therefore
accepted instead of rate of turn and acceleration if the device is already configured for them.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.xbus.mtdata2 import Item, reals_in

_FRAME_BYTES = 5 + 5 + 7
"""Size of framing, packet counter and time, bytes."""
_ITEM_HEAD, _FLOAT = 3, 4


class RequiredOutput(NamedTuple):
    """One required output: alternative data items, and their name in singular and plural."""

    items: tuple[Item, ...]
    one: str
    many: str


ORIENTATION = (RequiredOutput((Item.QUATERNION,), "quaternion", "quaternions"),)
_INERTIAL = (
    RequiredOutput((Item.RATE_OF_TURN, Item.DELTA_Q), "rate of turn", "rates of turn"),
    RequiredOutput((Item.ACCELERATION, Item.DELTA_V), "acceleration", "accelerations"),
)
_FIELD = RequiredOutput((Item.MAGNETIC_FIELD,), "magnetic field", "magnetic fields")


def required_outputs(orientation: str, *, magnetometer: bool) -> tuple[RequiredOutput, ...]:
    """Return the outputs that a device with these settings must send.

    Parameters
    ----------
    orientation : {"device", "gateway"}
        Place where the orientation is computed.
    magnetometer : bool
        Whether the gateway uses the magnetometer.
    """
    if orientation == "device":
        return ORIENTATION
    return (*_INERTIAL, _FIELD) if magnetometer else _INERTIAL


def message_bytes(needs: tuple[RequiredOutput, ...]) -> int:
    """Return the size of the smallest sufficient message, bytes, with 32-bit floats."""
    reals = [reals_in(need.items[0]) or 0 for need in needs]
    return _FRAME_BYTES + sum(_ITEM_HEAD + _FLOAT * count for count in reals)
