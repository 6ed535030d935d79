"""Sockets to one VRPN server in the event loop.

The chunks passed on contain whole messages only, so that messages of both sockets form one valid
stream. The event loop calls the reader callbacks, so they cannot raise an error in the driver's
coroutine: their error is stored, and `VrpnLink.pause`, in which the coroutine waits, raises it.
Failures of the network are raised as `DeviceLostError`, other exceptions unchanged.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError
from jointfit_daemon.model import Chunk
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols.vrpn import encode, is_whole, whole_messages

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Self

    from jointfit_drivers.ports.tcp_connection import TcpConnection
    from jointfit_protocols.vrpn import VrpnContent


class VrpnLink:
    """TCP connection, and a UDP socket for poses if they are requested by UDP.

    Parameters
    ----------
    name : str
        Server, for messages.
    connection : TcpConnection
        Connection to the server; closed at the end.
    types : mapping of str to int
        Numbers of the message types of this side.
    take : callable
        Called with every chunk from the server, in order of arrival.
    """

    def __init__(
        self,
        name: str,
        connection: TcpConnection,
        types: Mapping[str, int],
        take: Callable[[Chunk], None],
    ) -> None:
        self._name = name
        self._connection = connection
        self._types = types
        self._take = take
        self._loop = asyncio.get_running_loop()
        self._udp: UdpSocket | None = None
        self._host = ""
        self._pending = b""
        self._arrived = asyncio.Event()
        self._failure: Exception | None = None
        self._sequence = 0
        self.foreign = 0
        """Datagrams that were dropped because they are no messages of the server."""

    def __enter__(self) -> Self:
        self._loop.add_reader(self._connection, self._call, self._read_tcp)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.remove_reader(self._connection)
        self._connection.close()
        if self._udp is not None:
            self._loop.remove_reader(self._udp)
            self._udp.close()

    def open_udp(self, host: str, local: str) -> int:
        """Open a UDP socket for datagrams of `host` and return its port."""
        self._host, self._udp = host, UdpSocket(local, 0, sender=host)
        self._loop.add_reader(self._udp, self._call, self._read_udp)
        return self._udp.port

    def send(self, *messages: VrpnContent) -> None:
        """Send messages by TCP.

        Raises
        ------
        DeviceLostError
            The connection is lost.
        """
        data = b""
        for message in messages:
            data += encode(message, self._types, sequence=self._sequence)
            self._sequence += 1
        try:
            self._connection.send(data)
        except OSError as error:
            raise self._lost(error) from error

    def wake(self) -> None:
        """End the current `pause`."""
        self._arrived.set()

    async def pause(self, seconds: float) -> None:
        """Wait for `wake`, at most `seconds`; raise errors of the callbacks."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(seconds, 0)):
                await self._arrived.wait()
        self._arrived.clear()
        if self._failure is not None:
            raise self._failure

    def _call(self, read: Callable[[], None]) -> None:
        try:
            read()
        except Exception as error:  # noqa: BLE001 - a callback passes its error to the coroutine
            self._failure = self._failure or error
            self._loop.remove_reader(self._connection)
            if self._udp is not None:
                self._loop.remove_reader(self._udp)
            self._arrived.set()

    def _read_tcp(self) -> None:
        try:
            segment = self._connection.receive()
        except OSError as error:
            raise self._lost(error) from error
        if segment is None:
            return
        data = self._pending + segment.data if self._pending else segment.data
        size = whole_messages(data)
        self._pending = data[size:]
        if size:
            self._take(Chunk(segment.t_ns, data[:size]))

    def _read_udp(self) -> None:
        if self._udp is None:
            return
        try:
            arrivals = self._udp.receive()
        except ConnectionRefusedError:  # forged: this socket sends nothing
            return
        except OSError as error:
            raise self._lost(error) from error
        for arrival in arrivals:
            if arrival.host == self._host and is_whole(arrival.data):
                self._take(Chunk(arrival.t_ns, arrival.data))
            else:
                self.foreign += 1

    def _lost(self, error: OSError) -> DeviceLostError:
        return DeviceLostError(
            f"{self._name}: {error.strerror or error}: check network cable and network card, and "
            "that the camera software runs"
        )
