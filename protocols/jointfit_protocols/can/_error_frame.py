"""Descriptions of CAN error frames in Linux's layout (linux/can/error.h).

An error frame is never sent on the bus. The controller or its driver generates it.

Invariant: every error frame has a description.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jointfit_protocols.can._frame import CanFrame

_CLASSES = (
    (0x040, "bus off: the controller left the bus (check bitrate, wiring and termination)"),
    (0x020, "no acknowledgment: no other node on the bus, or another bitrate"),
    (0x008, "protocol violation (noise, wrong bitrate or wrong termination)"),
    (0x010, "transceiver fault (wiring)"),
    (0x002, "arbitration lost"),
    (0x001, "transmit timeout"),
    (0x080, "bus error"),
    (0x100, "controller restarted after bus off"),
)
_CONTROLLER = 0x004
_CONTROLLER_STATES = (
    (0x30, "error passive: many frames are destroyed (check bitrate, wiring and termination)"),
    (0x0C, "error warning level reached"),
    (0x01, "receive overflow: the controller lost frames"),
    (0x02, "transmit overflow"),
    (0x40, "error active again"),
)
_SERIOUS = 0x040 | 0x020 | 0x010


class CanError(NamedTuple):
    """Description of an error frame."""

    text: str
    serious: bool
    """Whether communication has stopped or is about to stop."""


def describe_error(frame: CanFrame) -> CanError:
    """Return the description of the error frame `frame`; unknown classes are listed by number."""
    found = [text for bit, text in _CLASSES if frame.can_id & bit]

    serious = bool(frame.can_id & _SERIOUS)
    if frame.can_id & _CONTROLLER:
        state = frame.data[1] if len(frame.data) > 1 else 0
        found += [text for bits, text in _CONTROLLER_STATES if state & bits]
        serious = serious or bool(state & 0x31)
    return CanError("; ".join(found) or f"CAN error class 0x{frame.can_id:x}", serious)
