"""UDP sockets that know when a datagram arrived. Law: the one place of this driver that does I/O.

The kernel stamps datagrams on arrival (SO_TIMESTAMPNS) in CLOCK_REALTIME; the stamp is taken to
CLOCK_MONOTONIC with a pair of readings made at the same wake-up. Both clocks are slewed alike, so
their difference changes only when the wall clock is stepped; then the stamps of that wake-up are
tried with the old difference and the new. `asyncio`'s datagram endpoint hides ancillary data, so
the sockets are our own.
"""

from __future__ import annotations

import fcntl
import socket
import struct
import sys
import time
from typing import NamedTuple

MAX_DATAGRAM = 65_507
DRAIN = 64
"""Datagrams taken at one wake-up; the rest waits for the next, so that others get their turn."""
RECEIVE_BUFFER = 1 << 20
"""Asked for, bytes: half a second of large frames while the host is busy."""

_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)  # x86-64 and ARM alike
_IP_RECVERR = 11  # an ICMP refusal becomes an error of this socket, connected or not
_IP_MULTICAST_ALL = 49  # 0: only groups that this socket joined
_SIOCGIFADDR = 0x8915
_STAMP = struct.Struct("@ll")
_ANCILLARY = socket.CMSG_SPACE(_STAMP.size)
_STEP_NS = 1_000_000
"""A larger change of the difference between the clocks is a step of the wall clock."""
_PLAUSIBLE_NS = 2_000_000_000
"""A datagram has not waited longer than this in the kernel."""


class WallClock:
    """Takes CLOCK_REALTIME to CLOCK_MONOTONIC.

    Attributes
    ----------
    soft : int
        Stamps replaced by the time of reading, because no clock explained them.
    """

    def __init__(self) -> None:
        self._offset_ns = self._before_ns = _wall_minus_monotonic()
        self.soft = 0

    def pair(self) -> None:
        """Compare the clocks anew: at every wake-up."""
        self._before_ns, self._offset_ns = self._offset_ns, _wall_minus_monotonic()

    def monotonic(self, stamp_ns: int, now_ns: int) -> int:
        """Return a wall-clock stamp as monotonic ns, never later than `now_ns`."""
        stepped = abs(self._offset_ns - self._before_ns) > _STEP_NS
        for offset in (self._offset_ns, self._before_ns)[: 1 + stepped]:
            arrival_ns = stamp_ns - offset
            if now_ns - _PLAUSIBLE_NS <= arrival_ns <= now_ns + _STEP_NS:
                return min(arrival_ns, now_ns)
        self.soft += 1
        return now_ns


def _wall_minus_monotonic() -> int:
    best, offset = sys.maxsize, 0
    for _ in range(5):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < best:
            best, offset = after - before, wall - (before + after) // 2
    return offset


class Arrival(NamedTuple):
    """One datagram."""

    t_ns: int
    """CLOCK_MONOTONIC when it reached the kernel."""
    data: bytes
    host: str
    """Address it came from."""


class StampedSocket:
    """A non-blocking UDP socket whose datagrams carry their arrival."""

    def __init__(self, address: str, port: int, *, shared: bool = False) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, _TIMESTAMPNS, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            self._socket.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
            if shared:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((address, port))
        except OSError:
            self._socket.close()
            raise
        self._wall = WallClock()

    @classmethod
    def in_group(cls, group: str, port: int, local: str) -> StampedSocket:
        """Open a socket that hears one multicast group on the network card of address `local`.

        It is bound to the group itself, so that other groups on the same port stay out.
        """
        opened = cls(group, port, shared=True)
        try:
            opened._socket.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            member = socket.inet_aton(group) + socket.inet_aton(local)
            opened._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError:
            opened.close()
            raise
        return opened

    def fileno(self) -> int:
        """Return the descriptor, for ``loop.add_reader``."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close; the group is left with it."""
        self._socket.close()

    def send(self, data: bytes, address: tuple[str, int]) -> None:
        """Send one datagram. A full queue of the network card loses it, as the network may."""
        try:
            self._socket.sendto(data, address)
        except BlockingIOError:
            return

    def receive(self) -> list[Arrival]:
        """Return what is there, at most `DRAIN` datagrams.

        Raises
        ------
        OSError
            Above all ConnectionRefusedError: nobody listens where we sent to.
        """
        self._wall.pair()
        found: list[Arrival] = []
        for _ in range(DRAIN):
            try:
                data, ancillary, _, address = self._socket.recvmsg(MAX_DATAGRAM, _ANCILLARY)
            except BlockingIOError:
                break
            now_ns = time.monotonic_ns()
            found.append(Arrival(self._arrival(ancillary, now_ns), data, address[0]))
        return found

    def _arrival(self, ancillary: list[tuple[int, int, bytes]], now_ns: int) -> int:
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _TIMESTAMPNS and len(value) == _STAMP.size:
                seconds, ns = _STAMP.unpack(value)
                return self._wall.monotonic(seconds * 10**9 + ns, now_ns)
        self._wall.soft += 1
        return now_ns


def local_address(server: str, interface: str | None) -> str:
    """Return the IPv4 address of the network card to use.

    Parameters
    ----------
    server : str
        Numeric address of the server.
    interface : str, optional
        Address or name of the card; None: the card that leads to the server.

    Raises
    ------
    OSError
        No such card, or no way to the server.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        if interface is None:
            probe.connect((server, 9))  # sends nothing: asks the routing table
            return str(probe.getsockname()[0])
        try:
            return socket.inet_ntoa(socket.inet_aton(interface))
        except OSError:
            name = struct.pack("256s", interface.encode()[:15])
            return socket.inet_ntoa(fcntl.ioctl(probe, _SIOCGIFADDR, name)[20:24])
