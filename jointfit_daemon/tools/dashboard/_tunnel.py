"""Tunnel from a WebSocket of the page to the TCP or TLS port of the broker.

Invariant: the tunnel forwards bytes without decoding them. The page sends its own CONNECT packet.
Access therefore depends on the accounts and access lists of the broker, and the tunnel stores no
password.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import ssl
from typing import TYPE_CHECKING

from websockets.exceptions import ConnectionClosed

from jointfit_daemon.tools.dashboard._certificates import verification_fault

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from websockets.asyncio.server import ServerConnection

    from jointfit_daemon.tools.dashboard.addresses import BrokerAddress

BROKER_UNREACHABLE, BROKER_CLOSED = 4502, 4503
"""WebSocket close codes. The page shows the reason that accompanies the code."""
CONNECT_S = 5.0
"""Longest wait for the broker to accept the connection, s."""
_CHUNK_BYTES = 65536
_REASON_BYTES = 123
"""Maximum length of the reason in a close frame, bytes (RFC 6455, section 5.5)."""


async def tunnel(
    websocket: ServerConnection, broker: BrokerAddress, context: ssl.SSLContext | None
) -> None:
    """Connect to the broker and pass bytes in both directions until one side closes."""
    try:
        async with asyncio.timeout(CONNECT_S):
            reader, writer = await asyncio.open_connection(broker.host, broker.port, ssl=context)
    except (OSError, TimeoutError) as error:
        await websocket.close(BROKER_UNREACHABLE, close_reason(connection_fault(error)))
        return

    answered = asyncio.Event()
    try:
        await _first_completed(_upload(websocket, writer), _download(reader, websocket, answered))
        await websocket.close(BROKER_CLOSED, close_reason(_closure(broker, answered)))
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def _first_completed(*coroutines: Coroutine[None, None, None]) -> None:
    """Run until one of the coroutines ends; cancel the others."""
    tasks = [asyncio.create_task(each, name="dashboard tunnel") for each in coroutines]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


async def _upload(websocket: ServerConnection, writer: asyncio.StreamWriter) -> None:
    """Forward the packets of the page to the broker."""
    with contextlib.suppress(OSError, ConnectionClosed):
        async for packet in websocket:
            writer.write(packet if isinstance(packet, bytes) else packet.encode())
            await writer.drain()


async def _download(
    reader: asyncio.StreamReader, websocket: ServerConnection, answered: asyncio.Event
) -> None:
    """Forward the bytes of the broker to the page; set `answered` at the first byte.

    A page that reads slowly fills the buffers of `reader` and `websocket`. The tunnel then stops
    reading until the page continues, and the broker queues or drops messages.
    """
    with contextlib.suppress(OSError, ConnectionClosed):
        while chunk := await reader.read(_CHUNK_BYTES):
            answered.set()
            await websocket.send(chunk)


def _closure(broker: BrokerAddress, answered: asyncio.Event) -> str:
    """Return the probable reason why the broker closed the connection."""
    if answered.is_set():
        return "the broker closed the connection"
    # With TLS 1.3, the broker checks the client certificate after the client has completed the
    # handshake. The connection then ends without an answer.
    cause = (
        "it may require a client certificate" if broker.tls else "a port with TLS needs mqtts://"
    )
    return f"it closed the connection before it answered: {cause}; see its log"


async def broker_fault(broker: BrokerAddress, context: ssl.SSLContext | None) -> str | None:
    """Return the reason why the broker cannot be reached now; None if it is reachable."""
    try:
        async with asyncio.timeout(CONNECT_S):
            _, writer = await asyncio.open_connection(broker.host, broker.port, ssl=context)
    except (OSError, TimeoutError) as error:
        return connection_fault(error)
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return None


def connection_fault(error: BaseException) -> str:
    """Return the cause of a failed connection as text."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return verification_fault(error)
    # A broker without TLS may reset the connection during the handshake.
    if isinstance(error, ssl.SSLError | ConnectionResetError):
        return "the port does not answer to TLS: check the port, or use mqtt://"
    words: dict[type[BaseException], str] = {
        TimeoutError: "the host does not answer: check its address and the network",
        socket.gaierror: "unknown host name: check --broker",
    }
    if type(error) in words:
        return words[type(error)]

    # If a name has several addresses, asyncio raises one error that contains only the error texts.
    if isinstance(error, ConnectionRefusedError) or "Connect call failed" in str(error):
        return "connection refused: start the broker, or correct --broker"
    if isinstance(error, OSError) and error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        return "no route to the host: check the network"
    return "the connection failed: check the broker's log"


def close_reason(text: str) -> str:
    """Return `text`, shortened to the maximum length of a close reason."""
    return text.encode()[:_REASON_BYTES].decode(errors="ignore")
