"""Simulated NatNet server, tested with an independent client and with the codec."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from typing import TYPE_CHECKING, Any

import natnet  # type: ignore[import-untyped]
import pytest

from jointfit_protocols.natnet import (
    Bare,
    CommandRequest,
    CommandResponse,
    Connect,
    Discovery,
    EchoRequest,
    EchoResponse,
    FrameOfData,
    Message,
    ModelDefinition,
    NatNetMessageId,
    ServerInfo,
    decode,
    encode,
)
from jointfit_simulators.devices import NatNetServer, NatNetServerOptions, RigidBodyAsset
from tests.drivers.motion_capture.oracle_client import needs_client, oracle_frames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 7)
SHANK = RigidBodyAsset("Shank", ("S1", "S2"), 8)
HALF = 0.5**0.5
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
PLACES = {"T1": (1.0, 2.0, 3.0), "T2": None, "T3": (0.5, 0.25, 0.125), "S1": (0.0, 0.0, 1.0)}
POSES = {"Thigh": ((1.0, 2.0, 3.0), UPRIGHT), "Shank": None}


@contextlib.asynccontextmanager
async def serving(**options: Any) -> AsyncIterator[NatNetServer]:
    server = NatNetServer(NatNetServerOptions(bodies=(THIGH, SHANK), **options))
    task = asyncio.create_task(server.run())
    await server.ready.wait()
    try:
        yield server
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        server.unplug()


class BareClient:
    """Client that sends messages and receives single datagrams."""

    def __init__(self, server: NatNetServer) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.connect(("127.0.0.1", server.command_port))
        self.version = server.bitstream

    async def ask(self, message: Message) -> object:
        self.socket.send(encode(message))
        return await self.receive()

    async def receive(self) -> object:
        async with asyncio.timeout(2):
            data = await asyncio.get_running_loop().sock_recv(self.socket, 65536)
        return decode(data, self.version)


@contextlib.asynccontextmanager
async def calling(**options: Any) -> AsyncIterator[tuple[NatNetServer, BareClient]]:
    async with serving(**options) as server:
        client = BareClient(server)
        with contextlib.closing(client.socket):
            yield server, client


def listen(server: NatNetServer, multicast: bool) -> tuple[Any, list[Any]]:
    """Connect with the independent client; return the model and at least five frames."""
    client = natnet.NatNetClient(
        "127.0.0.1",
        "127.0.0.1",
        use_multicast=multicast,
        command_port=server.command_port,
        data_port=server.data_port,
    )
    models: list[Any] = []
    frames: list[Any] = []
    client.on_data_description_received_event.handlers.append(models.append)
    client.on_data_frame_received_event.handlers.append(frames.append)
    try:
        client.connect()
        client.request_modeldef()
        until = time.monotonic() + 5
        while (len(frames) < 5 or not models) and time.monotonic() < until:
            client.update_sync()
            time.sleep(0.005)
    finally:
        client.shutdown()
    return models[0], frames


@pytest.mark.parametrize("multicast", [False, True], ids=["unicast", "multicast"])
@pytest.mark.parametrize("version", [(3, 0), (3, 1), (4, 0), (4, 1), (4, 2)])
async def test_independent_client_reads_models_and_frames(
    version: tuple[int, int], multicast: bool
) -> None:
    transport = "multicast" if multicast else "unicast"
    async with serving(bitstream=version, transport=transport) as server:
        listening = asyncio.create_task(asyncio.to_thread(listen, server, multicast))
        while not listening.done():
            server.push(time.monotonic_ns(), PLACES, POSES)
            await asyncio.sleep(0.005)
        model, frames = await listening
    assert [(body.name, body.id_num) for body in model.rigid_bodies] == [("Thigh", 7), ("Shank", 8)]
    assert [s.name for s in model.marker_sets] == ["Thigh", "Shank", "all"]
    assert len(frames) >= 5
    thigh, shank = frames[-1].rigid_bodies
    assert thigh.pos == (1.0, 3.0, -2.0)  # y up on the wire
    assert thigh.rot == pytest.approx((-HALF, 0.0, 0.0, HALF), abs=1e-7)
    assert (thigh.tracking_valid, shank.tracking_valid) == (True, False)
    assert [(m.model_id, m.marker_id) for m in frames[-1].labeled_markers] == [
        (7, 1),
        (7, 3),
        (8, 1),
    ]
    assert frames[-1].labeled_markers[0].pos == (1.0, 3.0, -2.0)
    numbers = [frame.prefix.frame_number for frame in frames]
    assert numbers == sorted(numbers)
    stamp = frames[-1].suffix.stamp_camera_mid_exposure
    assert abs(stamp * 100 - time.monotonic_ns()) < 5e9


@pytest.mark.parametrize(
    "connect",
    [Connect(0), Connect(5), Connect(264, "x"), Connect(269, "x"), Connect(271, "Ping")],
)
async def test_all_forms_of_connect_are_answered(connect: Connect) -> None:
    async with calling() as (server, client):
        info = await client.ask(connect)
    assert isinstance(info, ServerInfo)
    assert (info.application, info.clock_hz, info.multicast) == ("Motive", 10_000_000, False)
    assert info.data_port == server.data_port


async def test_discovery_is_answered_without_adding_a_client() -> None:
    async with calling() as (server, client):
        assert isinstance(await client.ask(Discovery(Connect(264))), ServerInfo)
        assert server.clients == ()


async def test_requests_are_answered_and_unknown_ones_rejected() -> None:
    async with calling(rate_hz=200.0) as (_, client):
        assert await client.ask(CommandRequest("FrameRate")) == CommandResponse(b"\0\0HC")
        assert await client.ask(CommandRequest("Dance")) == Bare(
            NatNetMessageId.UNRECOGNIZED_REQUEST
        )


async def test_echo_returns_a_clock_with_offset_and_skew() -> None:
    async with calling(clock_hz=3_312_787, device_ns=lambda ns: ns + ns // 20_000 + 10**12) as (
        _,
        client,
    ):
        before = time.monotonic_ns()
        echo = await client.ask(EchoRequest(42))
        after = time.monotonic_ns()
    assert isinstance(echo, EchoResponse)
    assert echo.stamp == 42
    shown = echo.ticks * 10**9 / 3_312_787
    assert before * 1.00005 + 1e12 - 1e3 <= shown <= after * 1.00005 + 1e12 + 1e3


async def test_no_frame_is_sent_before_the_model_description() -> None:
    async with calling() as (server, client):
        await client.ask(Connect(0))
        server.push(0, PLACES, POSES)
        assert isinstance(await client.ask(Bare(NatNetMessageId.REQUEST_MODELDEF)), ModelDefinition)
        server.push(0, PLACES, POSES)
        assert isinstance(await client.receive(), FrameOfData)
        assert server.sent == 1


async def test_client_without_a_model_request_receives_frames_after_50_ms() -> None:
    async with calling() as (server, client):
        await client.ask(Connect(0))
        await asyncio.sleep(0.06)
        server.push(0, PLACES, POSES)
        assert isinstance(await client.receive(), FrameOfData)


async def test_silent_client_is_disconnected_with_a_message() -> None:
    async with calling(keepalive_s=0.05) as (server, client):
        await client.ask(Connect(0))
        await asyncio.sleep(0.06)
        server.push(0, PLACES, POSES)
        assert await client.receive() == Bare(NatNetMessageId.DISCONNECTBYTIMEOUT)
        assert server.clients == ()


@pytest.mark.parametrize(("hiding", "count", "params"), [("missing", 2, 10), ("filled", 3, 11)])
async def test_occluded_markers_are_represented_as_in_real_frames(
    hiding: str, count: int, params: int
) -> None:
    async with calling(hiding=hiding) as (server, client):
        await client.ask(Connect(0))
        await client.ask(Bare(NatNetMessageId.REQUEST_MODELDEF))
        places = {"T1": (1.0, 2.0, 3.0), "T2": (4.0, 5.0, 6.0), "T3": (0.0, 0.0, 1.0)}
        server.push(0, places, POSES)
        await client.receive()
        server.push(0, places | {"T2": None}, {"Thigh": None})
        frame = await client.receive()
    assert isinstance(frame, FrameOfData)
    assert len(frame.markers) == count
    assert frame.markers[1].params == params
    body = frame.bodies[0]
    assert (body.x, body.y, body.z, body.params) == (1.0, 3.0, -2.0, 0)  # last pose, bit 0 clear


async def test_unicast_client_selects_its_bitstream_from_4_0() -> None:
    async with calling(bitstream=(4, 0)) as (server, client):
        await client.ask(Connect(0))
        await client.ask(Bare(NatNetMessageId.REQUEST_MODELDEF))
        answer = await client.ask(CommandRequest("Bitstream,4.1"))
        assert isinstance(answer, CommandResponse)
        assert answer.text == "Bitstream,4.1"
        server.push(0, PLACES, POSES)
        client.version = (4, 1)
        frame = await client.receive()
        assert isinstance(frame, FrameOfData)
        assert frame.params & 8


@pytest.mark.parametrize("fault", ["loss", "duplication", "reordering", "hostile"])
async def test_network_faults_have_their_probability(fault: str) -> None:
    async with calling(**{fault: 0.5}) as (server, client):
        await client.ask(Connect(0))
        await client.ask(Bare(NatNetMessageId.REQUEST_MODELDEF))
        for _ in range(60):
            server.push(0, PLACES, POSES)
        received = [await client.receive() for _ in range(server.sent)]
    numbers = [frame.number for frame in received if isinstance(frame, FrameOfData)]
    observed = {
        "loss": len(numbers) < 50,
        "duplication": len(numbers) > 70 and len(set(numbers)) == 60,
        "reordering": numbers != sorted(numbers) and len(set(numbers)) >= 59,
        "hostile": len(received) == 60 and len(numbers) < 50,
    }
    assert observed[fault]


@needs_client
@pytest.mark.parametrize("version", [(3, 1), (4, 0), (4, 1)], ids=str)
async def test_another_independent_client_reads_visible_bodies_only(
    version: tuple[int, int],
) -> None:
    async with serving(bitstream=version, copy_to_data_port=True, up_axis="z") as server:

        async def push() -> None:
            while True:
                server.push(time.monotonic_ns(), PLACES, POSES)
                await asyncio.sleep(0.01)

        pushing = asyncio.create_task(push())
        settings = {"interface_ip": "127.0.0.1", "port_command": str(server.command_port)}
        async with oracle_frames("optitrack", hostname="127.0.0.1", **settings) as next_frame:
            seen = [await next_frame() for _ in range(5)]
        pushing.cancel()
    assert seen[1:] == [{"Thigh": [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]}] * 4
