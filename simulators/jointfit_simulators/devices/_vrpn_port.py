"""Sockets of a simulated VRPN server. Invariant: they are bound to the loopback interface only."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_simulators.devices._natnet_port import Address

LOOPBACK = "127.0.0.1"
_TRIES = 50
_READ_BYTES = 1 << 16
_MOST_UNSENT = 1 << 20
"""Number of unsent bytes at which a client is disconnected."""


class VrpnPeer:
    """One TCP connection to a client."""

    def __init__(self, connected: socket.socket, take: Callable[[VrpnPeer, bytes], None]) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._take = connected, take
        self._unsent = b""
        self.host = str(connected.getpeername()[0])
        self.open = True
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(connected, self._readable)

    def send(self, data: bytes) -> bool:
        """Send bytes; return whether the connection is open."""
        self._unsent += data
        try:
            sent = self._socket.send(self._unsent) if self.open else 0
        except BlockingIOError:
            sent = 0
        except OSError:
            self.close()
            return False
        self._unsent = self._unsent[sent:]
        if len(self._unsent) > _MOST_UNSENT:
            self.close()
        return self.open

    def close(self) -> None:
        """Close the connection; do nothing if it is closed."""
        if self.open:
            self.open = False
            with contextlib.suppress(RuntimeError):  # event loop closed
                self._loop.remove_reader(self._socket)
            self._socket.close()

    def _readable(self) -> None:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._take(self, data)
        else:
            self.close()


class VrpnPort:
    """TCP and UDP port with the same number, which can be unplugged and plugged in again.

    Parameters
    ----------
    port : int
        Port number; 0 selects a free port, which `plug` opens again.
    """

    def __init__(self, port: int = 0) -> None:
        self.port = port
        self._tcp: socket.socket | None = None
        self._udp: socket.socket | None = None
        self._serving: tuple[Callable[[socket.socket], None], Callable[..., None]] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.plug()

    def plug(self) -> None:
        """Open both sockets; do nothing if they are open."""
        if self._tcp is not None:
            return
        for _ in range(_TRIES):
            tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tcp.bind((LOOPBACK, self.port))
                number = int(tcp.getsockname()[1])
                udp.bind((LOOPBACK, number))
                tcp.listen()
            except OSError:  # another program uses this UDP port
                tcp.close()
                udp.close()
                if self.port:
                    raise
                continue
            tcp.setblocking(False)
            udp.setblocking(False)
            self.port, self._tcp, self._udp = number, tcp, udp
            break
        if self._serving is not None:
            self._watch()

    def unplug(self) -> None:
        """Close both sockets; connections to the port are then refused."""
        for opened in (self._tcp, self._udp):
            if opened is not None:
                with contextlib.suppress(RuntimeError):  # no event loop uses the port
                    asyncio.get_running_loop().remove_reader(opened)
                opened.close()
        self._tcp = self._udp = None

    async def serve(
        self,
        connected: Callable[[socket.socket], None],
        handle: Callable[[bytes, Address], None],
    ) -> None:
        """Call the callbacks for every connection and datagram until cancelled.

        The calls continue after the port was unplugged and plugged in.
        """
        self._serving = (connected, handle)
        self._watch()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            self._serving = None
            for opened in (self._tcp, self._udp):
                if opened is not None:
                    asyncio.get_running_loop().remove_reader(opened)
            for task in self._tasks:
                task.cancel()

    def connect_back(self, address: Address) -> None:
        """Connect to a client that listens at `address`."""
        task = asyncio.get_running_loop().create_task(self._connect_back(address))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def send(self, data: bytes, address: Address) -> bool:
        """Send one datagram; return whether the system accepted it."""
        if self._udp is None:
            return False
        try:
            self._udp.sendto(data, address)
        except OSError:  # client closed or queue full; UDP loses the datagram
            return False
        return True

    async def _connect_back(self, address: Address) -> None:
        opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        opened.setblocking(False)
        try:
            await asyncio.get_running_loop().sock_connect(opened, address)
        except OSError:
            opened.close()
            return
        if self._serving is None:
            opened.close()
        else:
            self._serving[0](opened)

    def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        if self._tcp is not None and self._udp is not None:
            loop.add_reader(self._tcp, self._accept)
            loop.add_reader(self._udp, self._read)

    def _accept(self) -> None:
        if self._tcp is None or self._serving is None:
            return
        with contextlib.suppress(OSError):
            opened, _ = self._tcp.accept()
            self._serving[0](opened)

    def _read(self) -> None:
        if self._udp is None or self._serving is None:
            return
        with contextlib.suppress(OSError):
            self._serving[1](*self._udp.recvfrom(_READ_BYTES))
