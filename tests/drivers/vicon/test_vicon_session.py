"""Connection to Vicon: handshake, changed subjects, search, diagnosis, and the vendor's client."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.vicon import ViconMocap, ViconSettings, _session
from jointfit_protocols.vicon import ObjectId
from jointfit_simulators.devices import RigidBodyAsset, TextServer, ViconServer, ViconServerOptions
from tests.drivers.motion_capture.mocap_run import MocapRun, answering
from tests.drivers.motion_capture.oracle_client import needs_client, oracle_frames

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from jointfit_daemon.device_search import Finding

pytestmark = pytest.mark.real_time

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)
SHANK = RigidBodyAsset("Shank", ("S1",), 2)
POSE = ((1.0, 2.0, 3.0), (0.8, 0.0, 0.0, 0.6))


def made(**options: Any) -> ViconServer:
    usual: dict[str, Any] = {"bodies": (THIGH, SHANK), "rate_hz": 100}
    return ViconServer(ViconServerOptions(**(usual | options)))


def served(server: ViconServer, *, sends: bool = True) -> AbstractAsyncContextManager[None]:
    """Run a server that answers and, if `sends`, sends a frame every 10 ms."""

    def push() -> None:
        server.push(time.monotonic_ns(), {"T1": (0.1, 0.2, 0.3)}, {"Thigh": POSE})

    return answering(server, push if sends else None)


def settings_of(port: int, **table: Any) -> ViconSettings:
    keys = {"driver": "vicon", "server": "127.0.0.1", "command_port": port, "silence_s": 0.5}
    return ViconSettings.model_validate(keys | table)


def run_of(server: ViconServer, **table: Any) -> MocapRun:
    return MocapRun(ViconMocap(settings_of(server.command_port, **table)))


async def test_subjects_that_change_remain_bound_by_name() -> None:
    server = made()
    reading = run_of(server, rigid_body={"thigh": "Thigh"})
    async with served(server), reading.running():
        await reading.until(lambda: len(reading.frames) > 3)
        server.set_bodies((SHANK, RigidBodyAsset("New", ("N1",), 3), THIGH))
        await reading.until(lambda: "New" in reading.frames[-1].layout.bodies)
    for frame in reading.frames:
        column = frame.layout.bodies.index("Thigh")
        assert frame.body_positions[column].tolist() == pytest.approx(POSE[0])


async def test_the_announced_delay_and_pings_reach_the_frames() -> None:
    server = made(stages=(("Processing", 0.2),))
    reading = run_of(server)
    async with served(server), reading.running():
        await reading.until(lambda: len(reading.frames) > 110)
    (info,) = [i for i in reading.items if isinstance(i, DeviceEvent) and "delay_ms" in i.data]
    assert 200 <= float(str(info.data["delay_ms"])) < 400
    assert time.monotonic_ns() - reading.frames[-1].arrival_ns > 190_000_000


async def test_damaged_packets_are_rejected_as_a_whole() -> None:
    server = made(hostile=0.3, seed=2)
    reading = run_of(server)
    async with served(server), reading.running():
        await reading.until(lambda: len(reading.frames) > 30)
    assert reading.decoder.discarded_bytes > 0
    known = [frame for frame in reading.frames if "Thigh" in frame.layout.bodies]
    assert all(np.isfinite(frame.body_positions[0]).all() for frame in known[1:])


async def test_a_server_that_offers_no_poses_is_misconfigured() -> None:
    server = made()
    server.offer = frozenset((ObjectId.FRAME_INFO, ObjectId.CONTENTS))
    async with served(server, sends=False):
        with pytest.raises(DeviceMisconfiguredError, match="offers neither segments"):
            await ViconMocap(settings_of(server.command_port)).run(lambda _: None)


async def test_a_program_without_an_offer_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_session, "OFFER_S", 0.2)
    server = TextServer(b"")
    task = asyncio.create_task(server.run())
    with pytest.raises(DeviceLostError, match="no offer within"):
        await ViconMocap(settings_of(server.command_port)).run(lambda _: None)
    task.cancel()
    await asyncio.wait([task])
    server.unplug()


# --- search and diagnosis -------------------------------------------------------------------------


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_drivers.motion_capture._reception.FRAMES_S", 0.2)


@pytest.mark.usefixtures("short")
async def test_a_named_host_answers_with_its_names() -> None:
    server = made()
    async with served(server):
        (found,) = await ViconMocap.find_servers(
            ["127.0.0.1"], broadcast=True, port=server.command_port, wait_s=5
        )
    assert (found.driver, found.protocol) == ("vicon", "DataStream")
    assert found.bodies == ("Thigh", "Shank")
    assert found.markers == ("T1", "T2", "T3", "S1")
    assert await ViconMocap.find_servers(
        ["127.0.0.1"], broadcast=False, port=server.command_port, wait_s=0.3
    ) == []  # fmt: skip


async def findings(port: int, **table: Any) -> list[Finding]:
    return await ViconMocap.diagnose(settings_of(port, **table), 0.4)


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("table", "level", "text"),
    [
        ({"rigid_body": {"thigh": "Thigh"}}, "ok", "2 rigid bodies, 4 markers"),
        ({"rigid_body": {"thigh": "Tigh"}}, "warning", "did you mean 'Thigh'"),
        ({"rigid_body": {"shank": "Shank"}}, "warning", "'Shank' of shank was not tracked"),
    ],
)
async def test_the_content_of_the_stream_is_examined(
    table: dict[str, Any], level: str, text: str
) -> None:
    server = made()
    async with served(server):
        (found,) = await findings(server.command_port, **table)
    assert found.level == level
    assert text in found.text


@pytest.mark.usefixtures("short")
async def test_offline_and_no_program_are_told_apart() -> None:
    server = made()
    async with served(server, sends=False):
        (offline,) = await findings(server.command_port)
    (absent,) = await findings(server.command_port)
    assert "sends no frame" in offline.text
    assert "no program listens" in absent.text


# --- the vendor's client --------------------------------------------------------------------------


@needs_client
async def test_the_client_of_the_vendor_reads_the_bodies() -> None:
    server = made()
    hostname = f"127.0.0.1:{server.command_port}"
    async with served(server), oracle_frames("vicon", hostname=hostname) as next_frame:
        bodies = await next_frame()
        while not bodies:  # the first call may return an empty set
            bodies = await next_frame()
    assert list(bodies) == ["Thigh"]
    *position, w, x, y, z = bodies["Thigh"]
    assert position == pytest.approx(POSE[0], abs=1e-6)
    same = abs(sum(a * b for a, b in zip((w, x, y, z), POSE[1], strict=True)))
    assert same == pytest.approx(1, abs=1e-6)
