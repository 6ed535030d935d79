"""Kernel receive stamps of CAN frames, UNIX seconds, turned into host monotonic nanoseconds.

Law: arithmetic on clock readings (``wall_clock``); no socket, no bus. The kernel stamps the end of
a frame; what is wanted is its start.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from jointfit_drivers.ports._wall_clock import WallClock
from jointfit_protocols.can import frame_bits

if TYPE_CHECKING:
    from collections.abc import Callable

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
        self._wall = WallClock(monotonic_ns, unix_ns)
        self._bit_ns = _NS / bitrate
        self._monotonic_ns = monotonic_ns

    @property
    def unusable(self) -> int:
        """Stamps that fitted no clock and were replaced by the time of the read."""
        return self._wall.soft

    def pair(self) -> int:
        """Read both clocks; return the monotonic one, ns."""
        return self._wall.pair()

    def start_ns(self, unix_s: float, size: int, extended: bool) -> int:
        """Return the start of a frame of `size` bytes that the kernel stamped `unix_s`.

        Never after now. A stamp that lies more than 2 s before it, or after it by more than a
        millisecond, whatever the offset, is replaced by now.
        """
        # now, not at the wake-up: what came while this process was held up must not seem early
        end = self._wall.monotonic(round(unix_s * _NS), self._monotonic_ns())
        return end - round(frame_bits(size, extended) * self._bit_ns)
