"""Sockets to one NatNet server, which are read in the event loop.

Network failures are raised as `DeviceLostError`. Other exceptions are raised unchanged.

Frames are accepted from any port of the server, because multicast frames are sent from its data
port. Control messages are accepted only on the command socket, and only from the server's command
port.
"""

from __future__ import annotations

import errno
import time
from functools import partial
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError
from jointfit_daemon.model import Chunk
from jointfit_drivers.motion_capture import SocketLink
from jointfit_drivers.natnet._bitstream import FRAME_START
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols.natnet import encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from jointfit_drivers.motion_capture import Route
    from jointfit_protocols.natnet import Message

_FLEETING = {errno.ENOBUFS, errno.EMSGSIZE, errno.EINTR}
"""Error numbers that concern one datagram and not the connection."""
_FORGED_NS = 100_000_000
"""Time after a datagram from the server for which an ICMP refusal is ignored, ns.

A server that has just sent a datagram does not refuse datagrams, so the ICMP message is forged or
stale."""


class NatNetLink(SocketLink):
    """Command socket, and a second socket for multicast frames.

    Parameters
    ----------
    route : Route
        Addresses of the server and of this host's network card.
    port : int
        Command port of the server.
    take : callable
        Function that is called with every chunk from the server, in the order of arrival.
    """

    def __init__(self, route: Route, port: int, take: Callable[[Chunk], None]) -> None:
        super().__init__()
        self._server = (route.host, port)
        self._local = route.local
        self._take = take
        self._received_ns = 0
        self.foreign = 0
        """Number of datagrams that this class dropped because of their source.

        The kernel drops most datagrams of other hosts earlier. They are not counted."""

    @override
    def __enter__(self) -> Self:
        self._command = UdpSocket(self._local, 0, sender=self._server[0])
        self.watch(self._command, partial(self._read, self._command))
        return self

    def join(self, group: str, port: int) -> None:
        """Open the data socket of a multicast server; raise OSError if this fails."""
        data = UdpSocket.in_group(group, port, self._local, sender=self._server[0])
        self.watch(data, partial(self._read, data))

    def send(self, message: Message) -> None:
        """Send one message to the server's command port.

        Raises
        ------
        DeviceLostError
            The system cannot send to the server, for example because there is no route to it.
        """
        try:
            self._command.send(encode(message), self._server)
        except OSError as error:
            if error.errno not in _FLEETING and not self._is_forged(error):
                raise self._lost_error(error) from error

    def _read(self, source: UdpSocket) -> None:
        try:
            arrivals = source.receive()
        except OSError as error:
            if self._is_forged(error):
                return
            raise self._lost_error(error) from error

        for arrival in arrivals:
            is_command = source is self._command and arrival.port == self._server[1]
            is_accepted = is_command or arrival.data.startswith(FRAME_START)
            if arrival.host != self._server[0] or not is_accepted:
                self.foreign += 1
                continue
            self._received_ns = arrival.t_ns
            self._take(Chunk(arrival.t_ns, arrival.data))

    def _is_forged(self, error: OSError) -> bool:
        """Return whether an ICMP refusal contradicts datagrams that have just arrived."""
        recent = time.monotonic_ns() - self._received_ns < _FORGED_NS
        return recent and isinstance(error, ConnectionRefusedError)

    def _lost_error(self, error: OSError) -> DeviceLostError:
        host, port = self._server
        if isinstance(error, ConnectionRefusedError):
            text = "no program listens on this port: start Motive and switch streaming on"
        else:
            text = f"{error.strerror or error}: check network cable and network card, and server"
        return DeviceLostError(f"NatNet server {host}:{port}: {text}")
