"""TCP connections: arrival stamps, closed and silent servers, and connections from servers."""

from __future__ import annotations

import asyncio
import socket
import time

import pytest

from jointfit_drivers.ports.tcp_connection import TcpConnection, TcpListener
from tests.drivers.ports.socket_options import needs_kernel_stamps

LOOPBACK = "127.0.0.1"
STAMPS_BEGIN_S = 0.1
"""Time from the first request for stamps in this system until the kernel stamps data, s."""


def listening() -> socket.socket:
    opened = socket.create_server((LOOPBACK, 0))
    opened.settimeout(5)
    return opened


async def connected(server: socket.socket) -> tuple[TcpConnection, socket.socket]:
    port = server.getsockname()[1]
    opened = await TcpConnection.open(LOOPBACK, port, local=LOOPBACK, within_s=5)
    return opened, server.accept()[0]


@needs_kernel_stamps
async def test_data_are_stamped_by_their_arrival_and_not_by_the_read() -> None:
    with listening() as server:
        ours, theirs = await connected(server)
        with theirs:
            assert ours.receive() is None
            await asyncio.sleep(STAMPS_BEGIN_S)
            theirs.sendall(b"pose")
            sent_ns = time.monotonic_ns()
            await asyncio.sleep(0.1)
            segment = ours.receive()
            ours.send(b"request")
            assert theirs.recv(20) == b"request"
        ours.close()
    assert segment is not None
    assert segment.data == b"pose"
    assert abs(segment.t_ns - sent_ns) < 50_000_000


async def test_a_closed_connection_raises() -> None:
    with listening() as server:
        ours, theirs = await connected(server)
        theirs.sendall(b"last")
        theirs.close()
        await asyncio.sleep(0.02)
        segment = ours.receive()
        assert segment is not None
        assert segment.data == b"last"
        with pytest.raises(ConnectionResetError):
            ours.receive()
        ours.close()


async def test_a_refused_connection_leaves_no_socket() -> None:
    with listening() as server:
        port = server.getsockname()[1]
    with pytest.raises(ConnectionRefusedError):
        await TcpConnection.open(LOOPBACK, port, local=LOOPBACK, within_s=5)


async def test_requests_that_nobody_reads_raise() -> None:
    with listening() as server:
        ours, theirs = await connected(server)
        flood = bytes(1 << 26)  # more than the buffers of both sides
        with theirs, pytest.raises(OSError, match="does not read"):
            ours.send(flood)
        ours.close()


async def test_only_the_expected_host_may_connect_back() -> None:
    listener = TcpListener(LOOPBACK)
    address = (LOOPBACK, listener.port)
    with socket.create_connection(address), socket.create_connection(address):
        assert await listener.accept("10.0.0.1", 0.05) is None
    with socket.create_connection(address):
        accepted = await listener.accept(LOOPBACK, 5)
    listener.close()
    assert accepted is not None
    accepted.close()
