"""Kernel receive stamps of CAN frames, UNIX seconds, turned into host monotonic nanoseconds.

Law: arithmetic on three clock readings; no socket, no bus. Both clocks are slewed alike, so their
offset changes only when the wall clock is stepped; frames stamped before a step and read after it
are converted with the offset that puts them in the recent past.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from jointfit_protocols.can_frame import frame_bits

if TYPE_CHECKING:
    from collections.abc import Callable

_READINGS = 5  # of both clocks; the tightest counts
_STEP_NS = 1_000_000  # an offset that moved more than this was stepped, not slewed
_OLDEST_NS = 2_000_000_000  # no frame waits longer in a socket that is read
_NS = 1_000_000_000


class KernelStamps:
    """Converts the stamps of one bus; call ``pair`` at every wake-up.

    Parameters
    ----------
    bitrate
        Speed of the bus, bit/s: a frame's stamp is moved from its end to its start.
    monotonic_ns, unix_ns
        The two clocks; for tests.
    """

    def __init__(
        self,
        bitrate: int,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns, self._unix_ns = monotonic_ns, unix_ns
        self._bit_ns = _NS / bitrate
        self._offset = self._before_step = self._read_offset()
        self._now = 0
        self.unusable = 0
        """Stamps that fitted no offset and were replaced by the time of the read."""

    def pair(self) -> int:
        """Read both clocks; return the monotonic one, ns."""
        previous, self._offset = self._offset, self._read_offset()
        # Only the frames of this wake-up can have been stamped before the step.
        self._before_step = previous if abs(self._offset - previous) > _STEP_NS else self._offset
        self._now = self._monotonic_ns()
        return self._now

    def start_ns(self, unix_s: float, size: int, extended: bool) -> int:
        """Return the start of a frame of `size` bytes that the kernel stamped `unix_s`.

        Never after the last ``pair``. A stamp that lies more than 2 s before it, or after it by
        more than a millisecond, whatever the offset, is replaced by the last ``pair``.
        """
        stamp = round(unix_s * _NS)
        end = stamp - self._offset
        if not self._recent(end):
            end = stamp - self._before_step
            if not self._recent(end):
                self.unusable += 1
                end = self._now
        return min(end, self._now) - round(frame_bits(size, extended) * self._bit_ns)

    def _recent(self, t_ns: int) -> bool:
        return self._now - _OLDEST_NS <= t_ns <= self._now + _STEP_NS

    def _read_offset(self) -> int:
        """Return UNIX minus monotonic time, ns, from the quickest of five readings."""
        best_width, best = 1 << 62, 0
        for _ in range(_READINGS):
            before = self._monotonic_ns()
            unix = self._unix_ns()
            after = self._monotonic_ns()
            if after - before < best_width:
                best_width, best = after - before, unix - (before + after) // 2
        return best
