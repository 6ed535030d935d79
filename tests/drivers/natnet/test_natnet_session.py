"""The session of the NatNet driver with servers in every state, and with a recording."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.files.captures import read_capture
from jointfit_daemon.model import Chunk, ClockEcho, MocapFrame
from jointfit_drivers.natnet import NatNetMocap, NatNetSettings, _session
from jointfit_drivers.ports.udp_socket import UdpSocket, local_address
from jointfit_protocols.natnet import NatNetMessageId, ServerInfo, encode
from jointfit_simulators._contract_fixtures import DecodingReceiver
from jointfit_simulators.devices import NatNetServer, NatNetServerOptions, RigidBodyAsset
from tests.drivers.ports.socket_options import needs_kernel_stamps
from tests.simulators.natnet_replay import NatNetReplay

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)
SHANK = RigidBodyAsset("Shank", ("S1",), 2)
POSE = ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
SCENE: tuple[dict[str, Any], dict[str, Any]] = ({"T1": (1.0, 2.0, 3.0)}, {"Thigh": POSE})


@contextlib.asynccontextmanager
async def at_work(
    server: Any, **settings: Any
) -> AsyncIterator[tuple[DecodingReceiver, asyncio.Task[None]]]:
    """Run server and driver; yield the receiver and the driver's task."""
    table = {"driver": "natnet", "server": "127.0.0.1", "command_port": server.command_port}
    driver = NatNetMocap(NatNetSettings.model_validate(table | settings))
    heard = DecodingReceiver(driver, MocapFrame)
    tasks = [asyncio.create_task(server.run()), asyncio.create_task(driver.run(heard.emit))]
    try:
        yield heard, tasks[1]
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        server.unplug()


async def until(
    condition: Callable[[], object], server: NatNetServer | None, within_s: float = 5
) -> None:
    """Send frames until `condition` is true."""
    async with asyncio.timeout(within_s):
        while not condition():
            if server is not None:
                server.push(time.monotonic_ns(), *SCENE)
            await asyncio.sleep(0.005)


def serve(**options: Any) -> NatNetServer:
    return NatNetServer(NatNetServerOptions(bodies=(THIGH,), **options))


async def test_the_real_capture_plays_through_socket_and_driver_frame_by_frame(
    shared_data: Path,
) -> None:
    path = shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data" / "raw" / "traffic.pcapng"
    recorded = [(chunk.t_ns, chunk.data) for chunk in read_capture(path, "datagram")]
    server = NatNetReplay(recorded)
    async with at_work(server, up_axis="z") as (heard, _):
        await until(lambda: len(heard.measurements) >= 518, None, within_s=20)
        await asyncio.sleep(0.05)
    got = heard.measurements
    assert server.sent == server.frames == len(got) == 518
    assert [frame.number for frame in got] == list(range(162734, 163252))
    frames = [data for _, data in recorded if data[:1] == bytes([NatNetMessageId.FRAMEOFDATA])]
    assert [chunk.data for chunk in heard.chunks if len(chunk.data) == 336] == frames
    mean = np.mean([frame.body_positions[0] for frame in got], axis=0)
    assert mean == pytest.approx([0.1744416, 1.4471301, -0.7343158], abs=2e-6)
    span_s = (got[-1].arrival_ns - got[0].arrival_ns) / 1e9
    assert span_s == pytest.approx(517 * 0.0083343, rel=0.1)
    assert (heard.decoder.discarded_bytes, heard.decoder.unpublished) == (0, 0)  # type: ignore[attr-defined]


async def test_ten_echoes_in_the_first_second_hold_the_servers_clock() -> None:
    """Each echo contains a server time between the request and the arrival of the answer."""

    def clock_echoes() -> list[ClockEcho]:
        return [event for event in heard.events if isinstance(event, ClockEcho)]

    server = serve(clock_hz=3_312_787, device_ns=lambda ns: ns + 10**12)
    async with at_work(server) as (heard, _):
        await until(lambda: len(clock_echoes()) >= 10, server)
    echoes = clock_echoes()
    assert echoes[9].sent_ns - echoes[0].sent_ns < 1_000_000_000
    for echo in echoes:
        shown_ns = echo.ticks * 10**9 // 3_312_787 - 10**12
        assert echo.sent_ns - 1000 <= shown_ns <= echo.received_ns + 1000
    best = min(echo.received_ns - echo.sent_ns for echo in echoes)
    assert best < 50_000_000
    assert all(a.sent_ns < b.sent_ns for a, b in itertools.pairwise(echoes))


async def test_frames_while_the_clock_settles_are_not_dropped() -> None:
    server = serve()
    async with at_work(server) as (heard, _):
        await until(lambda: sum(isinstance(e, ClockEcho) for e in heard.events) >= 10, server)
    assert len(heard.measurements) >= 20
    assert heard.decoder.unpublished <= 2  # type: ignore[attr-defined]


@needs_kernel_stamps
async def test_arrival_is_stamped_by_the_kernel_before_the_daemon_wakes() -> None:
    server = serve()
    async with at_work(server) as (heard, _):
        await until(lambda: heard.measurements, server)
        await heard.settle()
        count, before = len(heard.measurements), time.monotonic_ns()
        server.push(time.monotonic_ns(), *SCENE)
        after = time.monotonic_ns()
        time.sleep(0.05)  # noqa: ASYNC251 - delays the event loop
        await until(lambda: len(heard.measurements) > count, None)
    assert before - 1_000_000 <= heard.measurements[count].arrival_ns <= after + 5_000_000


async def test_a_model_changed_while_running_is_asked_for_and_adopted() -> None:
    server = serve()
    async with at_work(server) as (heard, _):
        await until(lambda: heard.measurements, server)
        server.set_bodies((THIGH, SHANK))
        await until(lambda: heard.measurements[-1].layout.bodies == ("Thigh", "Shank"), server)


async def test_a_model_changed_unannounced_is_noticed_by_its_unknown_id() -> None:
    server = serve()
    async with at_work(server) as (heard, _):
        await until(lambda: heard.measurements, server)
        server.set_bodies((THIGH, SHANK))
        server._model_changed = 0
        await until(lambda: heard.measurements[-1].layout.bodies == ("Thigh", "Shank"), server)


@pytest.mark.parametrize("announced", [True, False])
async def test_a_bitstream_changed_while_running_is_followed(announced: bool) -> None:
    server = serve(bitstream=(4, 0))
    async with at_work(server) as (heard, _):
        await until(lambda: heard.measurements, server)
        server.set_bitstream((4, 1))
        if not announced:
            for client in server.clients:
                client.changed = 0
        count = len(heard.measurements) + 100
        await until(lambda: len(heard.measurements) > count, server)
    assert heard.decoder.discarded_bytes > 0


async def test_a_unicast_4_x_server_is_asked_for_the_bitstream_wanted() -> None:
    server = serve(bitstream=(4, 0))
    async with at_work(server, bitstream="4.1") as (heard, _):
        await until(lambda: heard.measurements, server)
        assert server.clients[0].version == (4, 1)


async def test_keepalives_keep_a_unicast_client() -> None:
    server = serve(keepalive_s=1.4)
    async with at_work(server) as (heard, task):
        await until(lambda: heard.measurements, server)
        began = time.monotonic()
        await until(lambda: time.monotonic() > began + 2, server)
        assert len(server.clients) == 1
        assert not task.done()


async def test_server_drops_a_client_whose_driver_stops() -> None:
    server = serve()
    async with at_work(server) as (heard, task):
        await until(lambda: heard.measurements, server)
        task.cancel()
        await asyncio.wait([task])
        await until(lambda: not server.clients, None)


async def test_port_without_listener_is_reported_as_lost_at_once() -> None:
    server = serve()
    server.unplug()
    driver = NatNetMocap(
        NatNetSettings(driver="natnet", server="127.0.0.1", command_port=server.command_port)
    )
    async with asyncio.timeout(1):
        with pytest.raises(
            DeviceLostError, match=f"127.0.0.1:{server.command_port}: no program listens"
        ):
            await driver.run(lambda _: None)


async def test_a_host_that_does_not_exist_is_lost_and_named() -> None:
    driver = NatNetMocap(NatNetSettings(driver="natnet", server="no-such-host.invalid"))
    with pytest.raises(DeviceLostError, match=r"no-such-host\.invalid"):
        await driver.run(lambda _: None)


async def test_a_network_card_that_does_not_exist_is_a_wrong_setting() -> None:
    driver = NatNetMocap(NatNetSettings(driver="natnet", server="127.0.0.1", interface="eth77"))
    with pytest.raises(DeviceMisconfiguredError, match="eth77"):
        await driver.run(lambda _: None)


class Claimant(NatNetServer):
    """Server that describes itself with given values."""

    claims: ServerInfo

    @override
    def _send_info(self, address: tuple[str, int], _: tuple[int, int]) -> None:
        self._port.send(encode(self.claims), address)


@pytest.mark.parametrize(
    ("claims", "settings", "words"),
    [
        (
            ServerInfo("Arena", (1, 4, 0, 0), (2, 4, 0, 0), None),
            {},
            "uses NatNet 2.4; 2.5 or newer",
        ),
        (ServerInfo("Motive", (5, 0, 0, 0), (5, 0, 0, 0), 10**7), {}, "bitstream = '4.1'"),
        (ServerInfo("Fake", (3, 0, 0, 0), (4, 0, 0, 0), 0), {}, "no clock frequency"),
        (
            ServerInfo("Motive", (3, 0, 0, 0), (4, 0, 0, 0), 10**7, multicast=True),
            {"bitstream": "4.1"},
            "switch Motive to unicast",
        ),
        (
            ServerInfo("M", (3, 0, 0, 0), (3, 0, 0, 0), 10**7, multicast=True, group="10.0.0.1"),
            {},
            "not a multicast address",
        ),
    ],
)
async def test_incompatible_server_is_rejected_with_a_remedy(
    claims: ServerInfo, settings: dict[str, Any], words: str
) -> None:
    server = Claimant()
    server.claims = claims
    async with at_work(server, **settings) as (_, task):
        await asyncio.wait([task], timeout=2)
        error = task.exception()
    assert isinstance(error, DeviceMisconfiguredError)
    assert words in str(error)


async def test_silence_names_the_transport_where_it_contradicts_the_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_session, "FIRST_ECHOES", 1)
    server = serve(transport="multicast")
    async with at_work(server, transport="unicast", silence_s=0.2) as (_, task):
        await asyncio.wait([task], timeout=3)
        error = task.exception()
    assert isinstance(error, DeviceLostError)
    assert "announces multicast, but transport = 'unicast'" in str(error)


async def test_a_server_that_answers_but_sends_no_frames_is_lost_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After the first loss, the driver emits answers of the server only with the first frame."""
    monkeypatch.setattr(_session, "FIRST_ECHOES", 1)
    server = serve()
    table = {"driver": "natnet", "server": "127.0.0.1", "silence_s": 0.2}
    driver = NatNetMocap(
        NatNetSettings.model_validate(table | {"command_port": server.command_port})
    )
    serving = asyncio.create_task(server.run())
    chunks: list[Chunk] = []
    texts: list[str] = []
    try:
        for _ in range(2):
            chunks = []
            with pytest.raises(DeviceLostError) as lost:
                await driver.run(chunks.append)
            texts.append(str(lost.value))
        assert chunks == [], "the second connection"
        assert texts[0] == texts[1]
        assert "no frame for 0.2 s: start streaming in the camera software" in texts[0]

        running = asyncio.create_task(driver.run(chunks.append))
        await until(lambda: len(chunks) > 2, server)
        running.cancel()
        times = [chunk.t_ns for chunk in chunks]
        assert times == sorted(times), "the answers first, then the frames"
    finally:
        serving.cancel()
        await asyncio.wait([serving])
        server.unplug()


# --- stamps -----------------------------------------------------------------------------------


@needs_kernel_stamps
def test_the_kernel_stamps_datagrams_on_loopback() -> None:
    opened = UdpSocket("127.0.0.1", 0, sender="127.0.0.1")
    try:
        address = opened._socket.getsockname()
        before = time.monotonic_ns()
        opened.send(b"x", address)
        after = time.monotonic_ns()
        time.sleep(0.02)
        (arrival,) = opened.receive()
    finally:
        opened.close()
    assert (arrival.data, arrival.host, opened._stamps.replaced) == (b"x", "127.0.0.1", 0)
    assert before - 200_000 <= arrival.t_ns <= after + 5_000_000


def test_a_wake_up_drains_at_most_64_datagrams() -> None:
    opened = UdpSocket("127.0.0.1", 0, sender="127.0.0.1")
    try:
        for _ in range(70):
            opened.send(b"x", opened._socket.getsockname())
        assert [len(opened.receive()), len(opened.receive())] == [64, 6]
    finally:
        opened.close()


def test_the_network_card_may_be_given_by_address_or_name() -> None:
    assert local_address("127.0.0.1", None) == "127.0.0.1"
    assert local_address("10.0.0.1", "127.0.0.1") == "127.0.0.1"
    assert local_address("10.0.0.1", socket.if_indextoname(1)) == "127.0.0.1"
