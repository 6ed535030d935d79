"""Conversion of the kernel's receive stamps of CAN frames to monotonic time of the host, ns.

The kernel stamps the end of a frame in UNIX time. The conversion returns the start of the frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S
from jointfit_drivers.ports._wall_clock import WallClock
from jointfit_protocols.can import frame_bits

if TYPE_CHECKING:
    from collections.abc import Callable


class KernelStamps(WallClock):
    """Converts the stamps of one bus. Call `pair` at every wake-up.

    Parameters
    ----------
    bitrate : int
        Bit rate of the bus, bit/s, which determines the duration of a frame.
    *clocks : callable
        The two clocks of `WallClock`, which tests replace.
    """

    def __init__(self, bitrate: int, *clocks: Callable[[], int]) -> None:
        super().__init__(*clocks)
        self._bit_ns = NS_PER_S / bitrate

    def start_ns(self, unix_s: float, size: int, extended: bool) -> int:
        """Return the start of a frame of `size` bytes, ns, from its kernel stamp `unix_s`.

        The start is ``t_end - frame_bits(size, extended) / bitrate``. ``t_end`` is the stamp, or
        the current time if the stamp is in the future or more than 2 s in the past.
        """
        # The limit is the current time, not the time of the wake-up. Otherwise frames that arrive
        # while this process is delayed would be stamped too early.
        end = self.monotonic(round(unix_s * NS_PER_S), self._monotonic_ns())
        return end - round(frame_bits(size, extended) * self._bit_ns)
