"""TCP connections that return the arrival time of received data.

The kernel stamps TCP segments at their arrival, and `SocketStamps` converts the stamps. The streams
of asyncio do not return these stamps (ancillary data), so this module reads the sockets itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import time
from typing import NamedTuple

from jointfit_drivers.ports._socket_stamps import ANCILLARY_BYTES, SocketStamps

READ_BYTES = 1 << 16
"""Largest number of bytes per read."""
RECEIVE_BUFFER = 1 << 20
"""Requested size of the receive buffer, bytes. It holds half a second of large frames while the
host is busy."""
IDLE_S, PROBE_S, PROBES = 5, 2, 3
"""Settings for the detection of a peer without power or cable: three unanswered probes, 2 s apart,
after 5 s of silence."""


class ReceivedBytes(NamedTuple):
    """Bytes that one read returned."""

    t_ns: int
    """CLOCK_MONOTONIC at which the last of these bytes arrived in the kernel, ns."""
    data: bytes


class TcpConnection:
    """A non-blocking TCP connection that returns the arrival time of received data.

    Parameters
    ----------
    connected : socket.socket
        Connected stream socket, which `close` closes.
    """

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        connected.setblocking(False)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, IDLE_S)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, PROBE_S)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, PROBES)
        self._stamps = SocketStamps(connected)

    @classmethod
    async def open(cls, host: str, port: int, *, local: str, within_s: float) -> TcpConnection:
        """Connect to a server.

        Parameters
        ----------
        host, port : str, int
            Numeric address and port of the server.
        local : str
            Address of the network card of this host to use.
        within_s : float
            Longest wait for the answer, s.

        Raises
        ------
        OSError
            The server refuses the connection, cannot be reached, or does not answer (TimeoutError).
        """
        opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            opened.bind((local, 0))
            async with asyncio.timeout(within_s):
                await asyncio.get_running_loop().sock_connect(opened, (host, port))
            return cls(opened)
        except BaseException:
            opened.close()
            raise

    def fileno(self) -> int:
        """Return the file descriptor, for ``loop.add_reader``."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def send(self, data: bytes) -> None:
        """Send a request.

        Raises
        ------
        OSError
            The connection is lost, or the server does not read.
        """
        sent = self._socket.send(data)
        # Requests are short. If a request does not fit into the send buffer of the kernel, the
        # server has not read the requests before it.
        if sent != len(data):
            raise OSError(errno.ENOBUFS, "the server does not read its requests")

    def receive(self) -> ReceivedBytes | None:
        """Return the bytes that have arrived; None if none have arrived.

        Raises
        ------
        OSError
            The connection is lost. If the server closed the connection, this is a
            ConnectionResetError.
        """
        self._stamps.pair()
        try:
            data, ancillary, _, _ = self._socket.recvmsg(READ_BYTES, ANCILLARY_BYTES)
        except BlockingIOError:
            return None
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "closed by the server")

        return ReceivedBytes(self._stamps.arrival(ancillary, time.monotonic_ns()), data)


class TcpListener:
    """Waits for one connection from a given host.

    Parameters
    ----------
    local : str
        Address of the network card of this host to use.
    """

    def __init__(self, local: str) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            self._socket.bind((local, 0))
            self._socket.listen(1)
        except OSError:
            self._socket.close()
            raise

    @property
    def port(self) -> int:
        """TCP port on which this object listens."""
        return int(self._socket.getsockname()[1])

    async def accept(self, host: str, within_s: float) -> TcpConnection | None:
        """Return the connection from `host`; None if `host` does not connect within `within_s`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while True:
                    loop = asyncio.get_running_loop()
                    connected, address = await loop.sock_accept(self._socket)
                    if address[0] == host:
                        return TcpConnection(connected)
                    connected.close()
        return None

    def close(self) -> None:
        """Stop listening. An accepted connection stays open."""
        self._socket.close()
