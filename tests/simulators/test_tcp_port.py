"""The simulated TCP server sends what a slow client has not read yet."""

from __future__ import annotations

import asyncio
import socket

from jointfit_simulators.devices._tcp_port import TcpClient, TcpPort

FRAME = bytes(100_000)


async def test_the_last_frame_reaches_a_client_that_reads_late() -> None:
    port, clients = TcpPort(), asyncio.Queue[TcpClient]()
    serving = asyncio.create_task(port.serve(clients.put_nowait, lambda _, __: None))
    with socket.create_connection(("127.0.0.1", port.port)) as connection:
        connection.setblocking(False)
        client = await clients.get()
        sent = 0
        while client.send(FRAME):  # until the client has left enough unread
            sent += len(FRAME)

        received, loop = 0, asyncio.get_running_loop()
        async with asyncio.timeout(5):
            while received < sent:
                received += len(await loop.sock_recv(connection, 1 << 20))
        assert received == sent
    serving.cancel()
    await asyncio.wait([serving])
    port.unplug()
