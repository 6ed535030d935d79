"""TCP port of a simulated server. Invariant: the port is bound to the loopback interface only."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_LOOPBACK = "127.0.0.1"
_BACKLOG = 16
_READ = 1 << 16
_MOST_QUEUED = 1 << 20
"""Number of unsent bytes at which frames to a client are dropped."""


class TcpClient:
    """One connected client.

    Parameters
    ----------
    connected : socket.socket
        Socket of the connection.
    """

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = connected
        self.address: tuple[str, int] = connected.getpeername()
        self._unsent = bytearray()

    def send(self, data: bytes, *, pieces: int = 1) -> bool:
        """Send data in `pieces` segments; return whether the data fit into the queue."""
        if len(self._unsent) > _MOST_QUEUED:
            return False
        size = -(-len(data) // pieces)
        for at in range(0, len(data), max(1, size)):
            self._unsent += data[at : at + size]
            self._flush()
        return True

    def _flush(self) -> None:
        with contextlib.suppress(OSError):  # client closed; a later read detects it
            sent = self.socket.send(self._unsent)
            del self._unsent[:sent]

        # The event loop sends the rest of this frame, because there may be no further frame.
        with contextlib.suppress(RuntimeError, ValueError, OSError):  # no event loop, or closed
            loop = asyncio.get_running_loop()
            loop.remove_writer(self.socket)
            if self._unsent:
                loop.add_writer(self.socket, self._flush)


class TcpPort:
    """Listening socket that can be unplugged and plugged in again.

    Parameters
    ----------
    port : int
        TCP port; 0 selects a free port, which `plug` opens again.
    """

    def __init__(self, port: int = 0) -> None:
        self.port = port
        self.clients: list[TcpClient] = []
        self._listening: socket.socket | None = None
        self._joined: Callable[[TcpClient], None] | None = None
        self._handle: Callable[[TcpClient, bytes], None] | None = None
        self.plug()

    def plug(self) -> None:
        """Open the port; do nothing if it is open."""
        if self._listening is not None:
            return
        opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.setblocking(False)
        opened.bind((_LOOPBACK, self.port))
        opened.listen(_BACKLOG)
        self.port = opened.getsockname()[1]
        self._listening = opened
        if self._handle is not None:
            asyncio.get_running_loop().add_reader(opened, self._accept)

    def unplug(self) -> None:
        """Close the port and disconnect all clients."""
        for client in list(self.clients):
            self.drop(client)
        opened, self._listening = self._listening, None
        if opened is not None:
            with contextlib.suppress(RuntimeError):  # without an event loop, the port is not served
                asyncio.get_running_loop().remove_reader(opened)
            opened.close()

    def drop(self, client: TcpClient) -> None:
        """Disconnect one client."""
        with contextlib.suppress(ValueError):
            self.clients.remove(client)
        with contextlib.suppress(RuntimeError, ValueError):
            asyncio.get_running_loop().remove_reader(client.socket)
            asyncio.get_running_loop().remove_writer(client.socket)
        client.socket.close()

    async def serve(
        self, joined: Callable[[TcpClient], None], handle: Callable[[TcpClient, bytes], None]
    ) -> None:
        """Call `joined` for each new client, and `handle` for its bytes, until cancelled."""
        loop = asyncio.get_running_loop()
        self._joined, self._handle = joined, handle
        if self._listening is not None:
            loop.add_reader(self._listening, self._accept)
        try:
            await loop.create_future()
        finally:
            self._joined = self._handle = None
            for client in list(self.clients):
                self.drop(client)
            if self._listening is not None:
                loop.remove_reader(self._listening)

    def _accept(self) -> None:
        if self._listening is None or self._joined is None:
            return
        with contextlib.suppress(OSError):  # the client has disconnected
            client = TcpClient(self._listening.accept()[0])
            self.clients.append(client)
            asyncio.get_running_loop().add_reader(client.socket, self._read, client)
            self._joined(client)

    def _read(self, client: TcpClient) -> None:
        try:
            data = client.socket.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.drop(client)
        elif self._handle is not None:
            self._handle(client, data)


class TextServer:
    """Server that sends one text to every client, and ignores all received bytes.

    Parameters
    ----------
    text : bytes
        Text that the server sends.
    """

    def __init__(self, text: bytes) -> None:
        self._text = text
        self._port = TcpPort()
        self.command_port = self._port.port
        self.unplug, self.plug = self._port.unplug, self._port.plug

    async def run(self) -> None:
        """Run until cancelled."""
        await self._port.serve(self._join, _ignore)

    def _join(self, client: TcpClient) -> None:
        client.send(self._text)


def _ignore(_: TcpClient, __: bytes) -> None:
    """Ignore received bytes."""
