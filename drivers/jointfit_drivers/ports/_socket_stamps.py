"""Arrival times of network data by the stamps of the kernel (SO_TIMESTAMPNS)."""

from __future__ import annotations

import socket
import struct

from jointfit_drivers.ports._wall_clock import WallClock

_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Socket option of the kernel stamps; the same number on x86-64 and ARM."""
_STAMP = struct.Struct("@ll")
ANCILLARY_BYTES = socket.CMSG_SPACE(_STAMP.size)
"""Size of the ancillary data of a read."""


class SocketStamps(WallClock):
    """Converts the stamps of one socket; call `pair` at every wake-up.

    Parameters
    ----------
    stamped : socket.socket
        Socket whose data the kernel stamps from now on.
    """

    def __init__(self, stamped: socket.socket) -> None:
        super().__init__()
        stamped.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)

    def arrival(self, ancillary: list[tuple[int, int, bytes]], now_ns: int) -> int:
        """Return the monotonic time, ns, at which data arrived; `now_ns` without a stamp."""
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _TIMESTAMPNS and len(value) == _STAMP.size:
                seconds, ns = _STAMP.unpack(value)
                return self.monotonic(seconds * 10**9 + ns, now_ns)
        self.replaced += 1
        return now_ns
