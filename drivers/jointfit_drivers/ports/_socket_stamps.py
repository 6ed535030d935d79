"""Arrival times of network data from the kernel's stamps (SO_TIMESTAMPNS)."""

from __future__ import annotations

import errno
import socket
import struct

from jointfit_drivers.ports._wall_clock import WallClock

_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Socket option for kernel stamps. Its number is the same on x86-64 and ARM."""
_STAMP = struct.Struct("@ll")
ANCILLARY_BYTES = socket.CMSG_SPACE(_STAMP.size)
"""Size of the ancillary data of one read, bytes."""


class SocketStamps(WallClock):
    """Converts the stamps of one socket. Call `pair` at every wake-up.

    If the system provides no stamps, for example in an emulator, the time of the read is used.

    Parameters
    ----------
    stamped : socket.socket
        Socket whose data the kernel stamps after this object is created.
    """

    def __init__(self, stamped: socket.socket) -> None:
        super().__init__()
        try:
            stamped.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)
        except OSError as error:
            if error.errno != errno.ENOPROTOOPT:
                raise

    def arrival(self, ancillary: list[tuple[int, int, bytes]], now_ns: int) -> int:
        """Return the monotonic time at which data arrived, ns; `now_ns` if there is no stamp."""
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _TIMESTAMPNS and len(value) == _STAMP.size:
                seconds, ns = _STAMP.unpack(value)
                return self.monotonic(seconds * 10**9 + ns, now_ns)
        self.replaced += 1
        return now_ns
