"""Sockets to one NatNet server inside the event loop.

Invariant: what fails in a callback is raised in `pause`. A reader callback has no caller to raise
to, so its failure is stored and raised where the driver's coroutine waits: `DeviceLostError` for
failures of the network, the exception itself for a bug.

Frames are accepted from any port of the server, because multicast frames leave its data port.
Control messages are accepted on the command socket only, and only from the server's command port.
"""

from __future__ import annotations

import asyncio
import errno
import time
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError
from jointfit_daemon.model import Chunk
from jointfit_drivers.ports.udp_socket import UdpSocket
from jointfit_protocols.natnet import MessageId, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType
    from typing import Self

    from jointfit_drivers.ports.udp_socket import Datagram
    from jointfit_protocols.natnet import Message

_FLEETING = {errno.ENOBUFS, errno.EMSGSIZE, errno.EINTR}
"""Errors that concern one datagram and not the connection."""
_FORGED_NS = 100_000_000
"""An ICMP refusal this soon after a datagram of the server is forged or stale, ns."""
_FRAME = int(MessageId.FRAMEOFDATA).to_bytes(2, "little")


class Link:
    """Command socket, and data socket where frames have their own.

    Parameters
    ----------
    host, port
        Numeric address and command port of the server.
    local : str
        Address of our network card.
    take : callable
        Called with every chunk from the server, in order of arrival.
    """

    def __init__(self, host: str, port: int, local: str, take: Callable[[Chunk], None]) -> None:
        self._server = (host, port)
        self._local = local
        self._take = take
        self._loop = asyncio.get_running_loop()
        self._sockets: list[UdpSocket] = []
        self._news = asyncio.Event()
        self._failure: Exception | None = None
        self._heard_ns = 0
        self.foreign = 0
        """Datagrams dropped because of where they came from; the kernel drops most others."""

    def __enter__(self) -> Self:
        self._command = self._open(UdpSocket(self._local, 0, sender=self._server[0]))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for opened in self._sockets:
            self._loop.remove_reader(opened)
            opened.close()

    def join(self, group: str, port: int) -> None:
        """Open the data socket of a multicast server; OSError as the system says."""
        self._open(UdpSocket.in_group(group, port, self._local, sender=self._server[0]))

    def send(self, message: Message) -> None:
        """Send one message to the server's command port.

        Raises
        ------
        DeviceLostError
            There is no way to the server.
        """
        try:
            self._command.send(encode(message), self._server)
        except OSError as error:
            if error.errno not in _FLEETING and not self._forged(error):
                raise self._lost(error) from error

    def wake(self) -> None:
        """End the current `pause`: something was said that the coroutine waits for."""
        self._news.set()

    async def pause(self, seconds: float) -> None:
        """Wait until something was said, at most `seconds`; raise what failed meanwhile."""
        if seconds > 0:
            try:
                async with asyncio.timeout(seconds):
                    await self._news.wait()
            except TimeoutError:
                pass
        self._news.clear()
        if self._failure is not None:
            raise self._failure

    def _open(self, opened: UdpSocket) -> UdpSocket:
        self._sockets.append(opened)
        self._loop.add_reader(opened, self._readable, opened)
        return opened

    def _readable(self, source: UdpSocket) -> None:
        try:
            self._read(source)
        except Exception as error:  # noqa: BLE001 - a callback hands its error to the coroutine
            self._failure = self._failure or error
            self._loop.remove_reader(source)
            self._news.set()

    def _read(self, source: UdpSocket) -> None:
        try:
            arrivals = source.receive()
        except OSError as error:
            if self._forged(error):
                return
            raise self._lost(error) from error
        for arrival in arrivals:
            frame = arrival.data.startswith(_FRAME)
            if arrival.host != self._server[0] or not (frame or self._commands(source, arrival)):
                self.foreign += 1
                continue
            self._heard_ns = arrival.t_ns
            self._take(Chunk(arrival.t_ns, arrival.data))

    def _commands(self, source: UdpSocket, arrival: Datagram) -> bool:
        """Return whether a datagram may carry a control message."""
        return source is self._command and arrival.port == self._server[1]

    def _forged(self, error: OSError) -> bool:
        """Return whether an ICMP refusal contradicts datagrams that have just arrived."""
        recent = time.monotonic_ns() - self._heard_ns < _FORGED_NS
        return recent and isinstance(error, ConnectionRefusedError)

    def _lost(self, error: OSError) -> DeviceLostError:
        host, port = self._server
        if isinstance(error, ConnectionRefusedError):
            text = "nothing listens there: is Motive running, and streaming switched on?"
        else:
            text = error.strerror or str(error)
        return DeviceLostError(f"NatNet server {host}:{port}: {text}")
