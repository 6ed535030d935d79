"""Events of corrupt data and errors on a CAN bus, for the decoder of one device on the bus.

The bus delivers records of 24 bytes. A record contains a CAN frame, an error frame of the
controller, or the number of frames or bytes that this host lost.

Invariant: the output depends only on the frames added. The module reads no clock and no bus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_protocols import can

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded, DeviceEventKind

_REPEAT_NS = 1_000_000_000
"""Shortest interval between two reports of the same error, ns."""


class BusEvents:
    """Counts discarded bytes, and reports errors of the bus."""

    def __init__(self) -> None:
        self.discarded_bytes = 0
        """Number of bytes in rejected records, plus the bytes from a serial adapter that formed no
        frame."""
        self._text = ""
        self._reported_ns = 0

    def discard(self, count: int, reason: str, rejected: int = 0) -> Corrupt:
        """Count `count` corrupt bytes of `rejected` messages, and return them as one `Corrupt`."""
        self.discarded_bytes += count
        return Corrupt(count, reason, rejected)

    def add_error_frame(self, frame: can.CanFrame) -> list[Decoded]:
        """Return the events of an error frame from the controller, its driver or the host."""
        if frame.can_id == can.HOST_CORRUPT:
            return [self.discard(can.host_count(frame), "no SLCAN line")]
        if frame.can_id == can.HOST_DROPPED:
            lost = can.host_count(frame)
            text = f"this host was too slow: the kernel dropped {lost} CAN frames"
            return [DeviceEvent("warning", text, {"dropped_frames": lost})]

        text, serious = can.describe_error(frame)
        return self.limit_event("error" if serious else "warning", text, frame.t_ns)

    def limit_event(self, kind: DeviceEventKind, text: str, t_ns: int) -> list[Decoded]:
        """Return the event in a list, or an empty list if it repeats the last event within 1 s."""
        if text == self._text and 0 <= t_ns - self._reported_ns < _REPEAT_NS:
            return []
        self._text, self._reported_ns = text, t_ns
        return [DeviceEvent(kind, text)]
