"""A NatNet server on another host, simulated by a network namespace, at the given address."""

from __future__ import annotations

import asyncio
import socket
import sys
import time

from jointfit_simulators.devices import (
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    _natnet_port,
)

POSE = ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))


async def serve(address: str) -> None:
    """Send a multicast frame every 10 ms, and answer requests and broadcasts."""
    _natnet_port.LOOPBACK = "0.0.0.0"  # by default, the simulator is bound to the loopback
    bodies = (RigidBodyAsset("Thigh", ("T1",), 1),)
    options = NatNetServerOptions(bodies, transport="multicast", command_port=1510, data_port=1511)
    server = NatNetServer(options)
    opened = server._port._socket
    assert opened is not None
    opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
    opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
    task = asyncio.create_task(server.run())
    while not task.done():
        server.push(time.monotonic_ns(), {}, {"Thigh": POSE})
        await asyncio.sleep(0.01)


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1]))
