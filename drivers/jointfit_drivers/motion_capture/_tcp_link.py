"""TCP connection of a driver in the event loop.

The event loop calls the reader, so it cannot raise an error in the driver's coroutine. Its error is
stored, and `TcpLink.pause`, in which the coroutine waits, raises it. Failures of the network are
raised as `DeviceLostError`, other exceptions unchanged.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError
from jointfit_drivers.ports.tcp_connection import TcpConnection

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from jointfit_drivers.motion_capture._route import Route
    from jointfit_drivers.ports.tcp_connection import Segment

CONNECT_S = 3.0
"""Longest wait for a connection, s."""
_MOST_READS = 16
"""Reads at one wake-up, so that other sources are served, too."""


class TcpLink:
    """One connection to a server.

    Parameters
    ----------
    name : str
        Name of the server for messages, with its port.
    remedy : str
        Advice for the case that no program listens.
    take : callable
        Called with all received bytes, in order of arrival.
    """

    def __init__(self, name: str, remedy: str, take: Callable[[Segment], None]) -> None:
        self._name = name
        self._remedy = remedy
        self._take = take
        self._loop = asyncio.get_running_loop()
        self._connection: TcpConnection | None = None
        self._arrived = asyncio.Event()
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._connection is not None:
            self._loop.remove_reader(self._connection)
            self._connection.close()

    async def open(self, route: Route, port: int) -> None:
        """Connect, and begin to read.

        Raises
        ------
        DeviceLostError
            The server refuses, does not answer or cannot be reached.
        """
        try:
            connection = await TcpConnection.open(
                route.host, port, local=route.local, within_s=CONNECT_S
            )
        except OSError as error:
            raise self._lost(error) from error
        self._connection = connection
        self._loop.add_reader(connection, self._readable)

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
            raise self._lost(error) from error

    def wake(self) -> None:
        """End the current `pause`: a message arrived."""
        self._arrived.set()

    def fail(self, error: Exception) -> None:
        """Make `pause` raise `error`, unless it raises an earlier one."""
        self._failure = self._failure or error
        self._arrived.set()

    async def pause(self, seconds: float) -> None:
        """Wait for `wake`, at most `seconds`; raise errors of the reader."""
        if seconds > 0 and self._failure is None:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._arrived.wait()
        self._arrived.clear()
        if self._failure is not None:
            raise self._failure

    def _readable(self) -> None:
        connection = self._connection
        if connection is None:
            return
        try:
            for _ in range(_MOST_READS):
                segment = connection.receive()
                if segment is None:
                    return
                self._take(segment)
        except OSError as error:
            self._stop(self._lost(error))
        except Exception as error:  # noqa: BLE001 - a callback passes its error to the coroutine
            self._stop(error)

    def _stop(self, error: Exception) -> None:
        if self._connection is not None:
            self._loop.remove_reader(self._connection)
        self.fail(error)

    def _lost(self, error: OSError) -> DeviceLostError:
        if isinstance(error, ConnectionRefusedError):
            text = f"no program listens on this TCP port: {self._remedy}"
        elif isinstance(error, ConnectionResetError):
            text = "the server closed the connection"
        elif isinstance(error, TimeoutError):
            text = f"no answer within {CONNECT_S:g} s: check server, network cable and firewalls"
        else:
            text = f"{error.strerror or error}: check network cable and network card, and server"
        return DeviceLostError(f"{self._name}: {text}")
