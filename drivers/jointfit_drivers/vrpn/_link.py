"""Sockets to one VRPN server, which are read in the event loop.

The emitted chunks contain only complete messages, so that the messages of both sockets form one
valid stream. Network failures are raised as `DeviceLostError`. Other exceptions are raised
unchanged.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError
from jointfit_daemon.model import Chunk
from jointfit_drivers.motion_capture import SocketLink
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols.vrpn import encode, is_whole, whole_messages

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_drivers.motion_capture import Route
    from jointfit_drivers.ports.tcp_connection import TcpConnection
    from jointfit_protocols.vrpn import VrpnContent


class VrpnLink(SocketLink):
    """TCP connection, and a UDP socket if poses are requested by UDP.

    Parameters
    ----------
    name : str
        Name of the server, for messages.
    connection : TcpConnection
        Connection to the server, which is closed at the end.
    types : mapping of str to int
        Numbers that this host uses for the message types.
    take : callable
        Function that is called with every chunk from the server, in the order of arrival.
    """

    def __init__(
        self,
        name: str,
        connection: TcpConnection,
        types: Mapping[str, int],
        take: Callable[[Chunk], None],
    ) -> None:
        super().__init__()
        self._name = name
        self._connection = connection
        self._types = types
        self._take = take
        self._pending = b""
        self._sequence = 0
        self.foreign = 0
        """Number of datagrams dropped because they contain no message of the server."""
        self.watch(connection, self._read_tcp)

    def open_udp(self, route: Route) -> int:
        """Open a UDP socket for datagrams from the server, and return its port."""
        udp = UdpSocket(route.local, 0, sender=route.host)
        self.watch(udp, partial(self._read_udp, udp, route.host))
        return udp.port

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
            raise self._lost_error(error) from error

    def _read_tcp(self) -> None:
        try:
            segment = self._connection.receive()
        except OSError as error:
            raise self._lost_error(error) from error
        if segment is None:
            return
        data = self._pending + segment.data if self._pending else segment.data
        size = whole_messages(data)
        self._pending = data[size:]
        if size:
            self._take(Chunk(segment.t_ns, data[:size]))

    def _read_udp(self, udp: UdpSocket, host: str) -> None:
        try:
            arrivals = udp.receive()
        except ConnectionRefusedError:  # forged, because this socket sends nothing
            return
        except OSError as error:
            raise self._lost_error(error) from error
        for arrival in arrivals:
            if arrival.host == host and is_whole(arrival.data):
                self._take(Chunk(arrival.t_ns, arrival.data))
            else:
                self.foreign += 1

    def _lost_error(self, error: OSError) -> DeviceLostError:
        return DeviceLostError(
            f"{self._name}: {error.strerror or error}: check network cable and network card, and "
            "that the camera software runs"
        )
