"""CPU time to publish a pose: with the daemon's connection, with aiomqtt alone, and by a socket.

The broker is a thread that accepts connections and discards the received data. The result is the
CPU time of the publishing thread only. As with the daemon's poses, a publisher sends a message
after its connection has accepted the previous message.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import statistics
import threading
import time
from functools import partial
from typing import TYPE_CHECKING

import aiomqtt

from bench.framework.measurement import loop_s, speed_experiment, timed_result
from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter, MqttConnection, Outgoing

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from bench.framework.experiment import Result

TOPIC = "jointfit/bench/pose"
PAYLOAD = b"x" * 1200
"""Payload with the length of a pose of two segments and three joints."""
MESSAGES = 200
_CONNACK = b"\x20\x03\x00\x00\x00"


@contextlib.contextmanager
def discarding_broker() -> Iterator[int]:
    """Yield the port of a broker that accepts MQTT 5 connections and discards their data."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve(connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.recv(4096)
            connection.sendall(_CONNACK)
            while connection.recv(1 << 16):
                pass

    def accept() -> None:
        with contextlib.suppress(OSError):  # the listening socket was closed
            while True:
                threading.Thread(target=serve, args=(listener.accept()[0],), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    with listener:
        yield listener.getsockname()[1]
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)


async def _send(connection: MqttConnection) -> None:
    accepted: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()
    await connection.send(Outgoing(TOPIC, PAYLOAD, expiry_s=2), accepted.set_result)
    await accepted


async def _cpu_s(publish: Callable[[], Awaitable[object]]) -> float:
    """Return the CPU time per message in this thread, s."""
    began = time.thread_time()
    for _ in range(MESSAGES):
        await publish()
    return (time.thread_time() - began) / MESSAGES


async def _measure(rounds: int) -> dict[str, list[float]]:
    """Return the CPU times of each publisher, s; the publishers are measured in turn."""
    asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
    times: dict[str, list[float]] = {}
    with discarding_broker() as port:
        settings = MqttSettings(host="127.0.0.1", port=port, base="jointfit/bench")
        plain = socket.create_connection(("127.0.0.1", port))
        plain.sendall(b"connect")
        peer = aiomqtt.Client("127.0.0.1", port, protocol=aiomqtt.ProtocolVersion.V5)
        async with MqttConnection(settings) as ours, peer:

            async def bare() -> None:
                plain.send(PAYLOAD)

            ways: dict[str, Callable[[], Awaitable[object]]] = {
                "jointfit": partial(_send, ours),
                "aiomqtt": partial(peer.publish, TOPIC, PAYLOAD),
                "socket": bare,
            }
            for _ in range(rounds):
                for name, publish in ways.items():
                    times.setdefault(name, []).append(await _cpu_s(publish))
        plain.close()
    return times


def publish_rows(quick: bool) -> list[Result]:
    """Return the CPU times, and the ratio of the daemon's time to the time of aiomqtt."""
    times = asyncio.run(_measure(3 if quick else 15))
    middle = {name: statistics.median(found) for name, found in times.items()}
    loop = loop_s()
    rows = [
        timed_result(
            name,
            round(1e6 * middle[key], 1),
            "µs",
            target,
            None,
            ratio=round(middle[key] / loop, 3),
        )
        for name, key, target in (
            ("publish: jointfit, one pose", "jointfit", 40),
            ("publish: aiomqtt, one pose", "aiomqtt", None),
            ("publish: a bare socket, as many bytes", "socket", None),
        )
    ]
    ratios = [a / b for a, b in zip(times["jointfit"], times["aiomqtt"], strict=True)]
    ratio = round(statistics.median(ratios), 3)
    return [*rows, timed_result("publish: time ratio to aiomqtt", ratio, "", 0.5, 1.0)]


EXPERIMENTS = (speed_experiment("publish-time", "A pose to the broker", publish_rows),)
