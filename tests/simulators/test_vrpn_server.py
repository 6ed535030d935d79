"""The simulated VRPN server, read by the reference client and by the codec."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_protocols import vrpn
from jointfit_protocols.vrpn import Cookie, TrackerPose, VrpnCodec, VrpnContent, encode
from jointfit_simulators.devices import VrpnServer, VrpnServerOptions
from tests.drivers.motion_capture.oracle_client import needs_client, oracle_frames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

POSES = {
    "Thigh": ((0.5, 1.0, -0.25), (0.8, 0.0, 0.0, 0.6)),
    "Shank": ((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, -0.5)),
    "Foot": None,
}


@contextlib.asynccontextmanager
async def serving(**options: Any) -> AsyncIterator[VrpnServer]:
    given = {"bodies": tuple(POSES), "up_axis": "z"} | options
    server = VrpnServer(VrpnServerOptions(**given))
    task = asyncio.create_task(server.run())
    await server.ready.wait()
    try:
        yield server
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        server.unplug()


async def answers(server: VrpnServer, request: bytes, wait_s: float = 0.1) -> list[VrpnContent]:
    """Return what the server sends by TCP to a client that sends `request`."""
    loop = asyncio.get_running_loop()
    codec = VrpnCodec()
    found: list[Any] = []
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as client:
        client.setblocking(False)
        await loop.sock_connect(client, ("127.0.0.1", server.command_port))
        await loop.sock_sendall(client, request)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                for _ in range(9):
                    found += codec.feed(await loop.sock_recv(client, 65536))
                    server.push(0, {}, POSES)
                    await asyncio.sleep(0.005)
    return found


@needs_client
@pytest.mark.parametrize("prefix", ["tcp://", ""], ids=["tcp", "classic-udp"])
async def test_the_reference_client_reads_visible_bodies_only(prefix: str) -> None:
    try:
        socket.gethostbyname(socket.gethostname())
    except OSError:
        pytest.skip("VRPN's reference client needs a host whose own name has an address")
    async with serving() as server:

        async def push() -> None:
            while True:
                server.push(0, {}, POSES)
                await asyncio.sleep(0.005)

        pushing = asyncio.create_task(push())
        found: dict[str, list[float]] = {}
        address = f"{prefix}127.0.0.1:{server.command_port}"
        async with oracle_frames("vrpn", hostname=address) as next_frame:
            for _ in range(300):
                found |= await next_frame()
                if len(found) > 1:
                    break
        pushing.cancel()

    # The client converts to single precision.
    expected = {n: [*pose[0], *pose[1]] for n, pose in POSES.items() if pose is not None}
    assert found == {n: np.array(values, np.float32).tolist() for n, values in expected.items()}


async def test_senders_and_types_are_described_before_use() -> None:
    async with serving() as server:
        found = await answers(server, encode(Cookie()))
    assert found[0] == Cookie(7, 38, 0)
    poses = [item for item in found if isinstance(item, TrackerPose)]
    names = {item.id: item.name for item in found if isinstance(item, vrpn.SenderDescription)}
    assert [names[pose.sender] for pose in poses[:2]] == ["Thigh", "Shank"]
    assert not any(isinstance(item, vrpn.VrpnMessage) for item in found)


async def test_another_major_version_is_disconnected() -> None:
    async with serving() as server:
        assert await answers(server, encode(Cookie(6, 10)), wait_s=5) == [Cookie(7, 38, 0)]
        assert server.clients == 0


async def test_a_ping_is_answered_with_the_type_that_the_server_described() -> None:
    ping: list[VrpnContent] = [
        Cookie(),
        vrpn.SenderDescription(40, "Shank"),
        vrpn.TypeDescription(9, vrpn.PING),
        vrpn.Ping(0, 40),
    ]
    async with serving() as server:
        found = await answers(server, b"".join(encode(item, {vrpn.PING: 9}) for item in ping))
    (pong,) = (item for item in found if isinstance(item, vrpn.Pong))
    names = {item.id: item.name for item in found if isinstance(item, vrpn.SenderDescription)}
    assert names[pong.sender] == "Shank"


async def test_the_wall_clock_steps() -> None:
    """A test can step the clock of the stamps."""
    async with serving() as server:
        server.stepped_ns = 10**10
        found = await answers(server, encode(Cookie()))
    pose = next(item for item in found if isinstance(item, TrackerPose))
    assert abs(pose.time_us - time.time_ns() // 1000 - 10_000_000) < 2_000_000


async def test_stamps_increase_over_frames_that_are_sent_at_once() -> None:
    loop, codec = asyncio.get_running_loop(), VrpnCodec()
    found: list[Any] = []
    async with serving(spread_us=1000) as server:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as client:
            client.setblocking(False)
            await loop.sock_connect(client, ("127.0.0.1", server.command_port))
            await loop.sock_sendall(client, encode(Cookie()))
            while not server.clients:
                await asyncio.sleep(0.005)
            for _ in range(3):  # a busy host sends several frames at once
                server.push(0, {}, POSES)
            async with asyncio.timeout(2):
                while len([item for item in found if isinstance(item, TrackerPose)]) < 6:
                    found += codec.feed(await loop.sock_recv(client, 65536))
    stamps_us = [item.time_us for item in found if isinstance(item, TrackerPose)]
    assert stamps_us == sorted(set(stamps_us))
