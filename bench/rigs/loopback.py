"""Difference between arrival stamp and sending time of datagrams while the reader is busy.

Invariant: the sender is a separate process, which writes CLOCK_MONOTONIC into each datagram
directly before the system call. The reader stamps with the same clock, so the difference needs no
model.
"""

from __future__ import annotations

import asyncio
import struct
import subprocess
import sys
import time
from typing import TYPE_CHECKING

from jointfit_drivers.ports.udp_socket import UdpSocket

if TYPE_CHECKING:
    from jointfit_drivers.ports.udp_socket import Datagram

_STAMP = struct.Struct("<q")
_SENDER = """
import socket, struct, sys, time
port, count = int(sys.argv[1]), int(sys.argv[2])
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.connect(("127.0.0.1", port))
for _ in range(count):
    time.sleep(0.002)
    sock.send(struct.pack("<q", time.monotonic_ns()))
"""


def delays_ns(count: int, blocked_s: float = 0.004) -> tuple[list[int], list[int]]:
    """Return, for every datagram, stamp minus sending time and reading minus sending time, ns.

    Parameters
    ----------
    count
        Number of datagrams, one every 2 ms.
    blocked_s
        Time for which the event loop of the reader is blocked between short pauses, s.
    """
    return asyncio.run(_measure(count, blocked_s))


async def _measure(count: int, blocked_s: float) -> tuple[list[int], list[int]]:
    opened = UdpSocket("127.0.0.1", 0, sender="127.0.0.1")
    arrivals: list[Datagram] = []
    read_ns: list[int] = []

    def readable() -> None:
        found = opened.receive()
        arrivals.extend(found)
        read_ns.extend([time.monotonic_ns()] * len(found))

    loop = asyncio.get_running_loop()
    loop.add_reader(opened.fileno(), readable)
    words = [sys.executable, "-c", _SENDER, str(opened.port), str(count)]
    sender = subprocess.Popen(words)  # noqa: ASYNC220, S603 - a fixed command, which ends by itself
    try:
        async with asyncio.timeout(30 + count * 0.01):
            while len(arrivals) < count:
                time.sleep(blocked_s)  # noqa: ASYNC251 - this is the load
                await asyncio.sleep(0.0005)
    finally:
        loop.remove_reader(opened.fileno())
        opened.close()
        sender.wait()
    sent = [_STAMP.unpack(arrival.data)[0] for arrival in arrivals]
    stamped = [arrival.t_ns - t for arrival, t in zip(arrivals, sent, strict=True)]
    return stamped, [read - t for read, t in zip(read_ns, sent, strict=True)]
