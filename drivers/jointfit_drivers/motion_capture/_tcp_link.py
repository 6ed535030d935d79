"""TCP connection to a server, which is read in the event loop.

Network failures are raised as `DeviceLostError`. Other exceptions are raised unchanged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError
from jointfit_drivers.motion_capture._socket_link import SocketLink
from jointfit_drivers.ports.tcp_connection import TcpConnection

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_drivers.motion_capture._route import Route
    from jointfit_drivers.ports.tcp_connection import ReceivedBytes

CONNECT_S = 3.0
"""Longest wait for a connection, s."""
_MOST_READS = 16
"""Largest number of reads per wake-up, so that other sources are processed as well."""


class TcpLink(SocketLink):
    """One connection to a server.

    Parameters
    ----------
    name : str
        Name and port of the server, for error messages.
    remedy : str
        Advice in the error message if no program listens on the port.
    take : callable
        Function that is called with all received bytes in the order of arrival.
    """

    def __init__(self, name: str, remedy: str, take: Callable[[ReceivedBytes], None]) -> None:
        super().__init__()
        self._name = name
        self._remedy = remedy
        self._take = take
        self._connection: TcpConnection | None = None

    async def open(self, route: Route, port: int) -> None:
        """Connect to the server, and begin to read.

        Raises
        ------
        DeviceLostError
            The server refuses the connection, does not answer, or cannot be reached.
        """
        try:
            connection = await TcpConnection.open(
                route.host, port, local=route.local, within_s=CONNECT_S
            )
        except OSError as error:
            raise self._lost_error(error) from error
        self._connection = connection

        def read() -> None:
            try:
                for _ in range(_MOST_READS):
                    segment = connection.receive()
                    if segment is None:
                        return
                    self._take(segment)
            except OSError as error:
                raise self._lost_error(error) from error

        self.watch(connection, read)

    def send(self, data: bytes) -> None:
        """Send a request.

        Raises
        ------
        DeviceLostError
            The connection is lost.
        """
        if self._connection is None:
            return
        try:
            self._connection.send(data)
        except OSError as error:
            raise self._lost_error(error) from error

    def _lost_error(self, error: OSError) -> DeviceLostError:
        if isinstance(error, ConnectionRefusedError):
            text = f"no program listens on this TCP port: {self._remedy}"
        elif isinstance(error, ConnectionResetError):
            text = "the server closed the connection"
        elif isinstance(error, TimeoutError):
            text = f"no answer within {CONNECT_S:g} s: check server, network cable and firewalls"
        else:
            text = f"{error.strerror or error}: check network cable and network card, and server"
        return DeviceLostError(f"{self._name}: {text}")
