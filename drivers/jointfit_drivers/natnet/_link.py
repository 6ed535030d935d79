"""Sockets to one NatNet server in the event loop.

The event loop calls the reader callbacks, so they cannot raise an error in the driver's coroutine.
Their error is stored, and `NatNetLink.pause`, in which the coroutine waits, raises it. Failures of
the network are raised as `DeviceLostError`, other exceptions unchanged.

Frames are accepted from any port of the server, because multicast frames leave its data port.
Control messages are accepted on the command socket only, and only from the server's command port.
"""

from __future__ import annotations

import asyncio
import errno
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError
from jointfit_daemon.model import Chunk
from jointfit_drivers.natnet._bitstream import FRAME_START
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols.natnet import encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    from jointfit_protocols.natnet import Message

_FLEETING = {errno.ENOBUFS, errno.EMSGSIZE, errno.EINTR}
"""Errors that concern one datagram and not the connection."""
_FORGED_NS = 100_000_000
"""Time, ns, after a datagram from the server for which an ICMP refusal is ignored.

A server that has just sent a datagram does not refuse: the ICMP message is forged or stale."""


class NatNetLink:
    """Command socket, and a data socket for multicast frames.

    Parameters
    ----------
    host, port : str, int
        Numeric address and command port of the server.
    local : str
        Address of this host's network card.
    take : callable
        Called with every chunk from the server, in order of arrival.
    """

    def __init__(self, host: str, port: int, local: str, take: Callable[[Chunk], None]) -> None:
        self._server = (host, port)
        self._local = local
        self._take = take
        self._loop = asyncio.get_running_loop()
        self._sockets: list[UdpSocket] = []
        self._arrived = asyncio.Event()
        self._failure: Exception | None = None
        self._received_ns = 0
        self.foreign = 0
        """Number of datagrams that this class dropped because of their source.

        The kernel drops most datagrams of other hosts before, and these are not counted."""

    def __enter__(self) -> Self:
        self._command = self._open(UdpSocket(self._local, 0, sender=self._server[0]))
        return self

    def __exit__(self, *_: object) -> None:
        for opened in self._sockets:
            self._loop.remove_reader(opened)
            opened.close()

    def join(self, group: str, port: int) -> None:
        """Open the data socket of a multicast server; raises the system's OSError."""
        self._open(UdpSocket.in_group(group, port, self._local, sender=self._server[0]))

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
            if error.errno not in _FLEETING and not self._forged(error):
                raise self._lost(error) from error

    def wake(self) -> None:
        """End the current `pause`: a message arrived."""
        self._arrived.set()

    async def pause(self, seconds: float) -> None:
        """Wait for a message, at most `seconds`; raise errors of the callbacks."""
        if seconds > 0:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._arrived.wait()

        self._arrived.clear()
        if self._failure is not None:
            raise self._failure

    def _open(self, opened: UdpSocket) -> UdpSocket:
        self._sockets.append(opened)
        self._loop.add_reader(opened, self._readable, opened)
        return opened

    def _readable(self, source: UdpSocket) -> None:
        try:
            self._read(source)
        except Exception as error:  # noqa: BLE001 - a callback passes its error to the coroutine
            self._failure = self._failure or error
            self._loop.remove_reader(source)
            self._arrived.set()

    def _read(self, source: UdpSocket) -> None:
        try:
            arrivals = source.receive()
        except OSError as error:
            if self._forged(error):
                return
            raise self._lost(error) from error

        for arrival in arrivals:
            is_command = source is self._command and arrival.port == self._server[1]
            is_accepted = is_command or arrival.data.startswith(FRAME_START)
            if arrival.host != self._server[0] or not is_accepted:
                self.foreign += 1
                continue
            self._received_ns = arrival.t_ns
            self._take(Chunk(arrival.t_ns, arrival.data))

    def _forged(self, error: OSError) -> bool:
        """Return whether an ICMP refusal contradicts datagrams that have just arrived."""
        recent = time.monotonic_ns() - self._received_ns < _FORGED_NS
        return recent and isinstance(error, ConnectionRefusedError)

    def _lost(self, error: OSError) -> DeviceLostError:
        host, port = self._server
        if isinstance(error, ConnectionRefusedError):
            text = "no program listens on this port: start Motive and switch streaming on"
        else:
            text = f"{error.strerror or error}: check network cable and network card, and server"
        return DeviceLostError(f"NatNet server {host}:{port}: {text}")
