"""UDP socket of a simulated NatNet server.

Invariant: the socket is bound to the loopback interface only.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

Address = tuple[str, int]

LOOPBACK = "127.0.0.1"
_MAX_DATAGRAM = 65_507
"""Largest payload of a UDP datagram over IPv4, bytes."""


class NatNetPort:
    """Command socket on the loopback interface, which can be unplugged and plugged in again.

    Parameters
    ----------
    command_port : int
        UDP port; 0 selects a free port, which `plug` opens again.
    data_port : int
        Announced port for data; 0 selects a free port.
    """

    def __init__(self, command_port: int = 0, data_port: int = 0) -> None:
        self.command_port = command_port
        if not data_port:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((LOOPBACK, 0))
                data_port = int(probe.getsockname()[1])
        self.data_port = data_port
        self._socket: socket.socket | None = None
        self._handle: Callable[[bytes, Address], None] | None = None
        self.plug()

    def plug(self) -> None:
        """Open the socket; do nothing if it is open."""
        if self._socket is not None:
            return
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        opened.bind((LOOPBACK, self.command_port))
        self.command_port = opened.getsockname()[1]
        self._socket = opened
        if self._handle is not None:
            asyncio.get_running_loop().add_reader(opened, self._readable)

    def unplug(self) -> None:
        """Close the socket; datagrams to its port are then rejected."""
        opened, self._socket = self._socket, None
        if opened is None:
            return
        with contextlib.suppress(RuntimeError):  # without an event loop, the port is not served
            asyncio.get_running_loop().remove_reader(opened)
        opened.close()

    async def serve(self, handle: Callable[[bytes, Address], None]) -> None:
        """Call `handle` for every datagram until cancelled.

        The calls continue after the port was unplugged and plugged in.
        """
        loop = asyncio.get_running_loop()
        self._handle = handle
        if self._socket is not None:
            loop.add_reader(self._socket, self._readable)
        try:
            await loop.create_future()
        finally:
            self._handle = None
            if self._socket is not None:
                loop.remove_reader(self._socket)

    def send(self, data: bytes, address: Address) -> bool:
        """Send one datagram; return whether the system accepted it."""
        if self._socket is None:
            return False
        try:
            self._socket.sendto(data, address)
        except OSError:  # client closed or queue full; UDP loses the datagram
            return False
        return True

    def _readable(self) -> None:
        while self._socket is not None and self._handle is not None:
            try:
                data, address = self._socket.recvfrom(_MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # ICMP error of a closed client
                continue
            self._handle(data, address)
