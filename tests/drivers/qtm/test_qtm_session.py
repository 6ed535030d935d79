"""Connection to QTM: versions, refusals, waiting, changes, and playback."""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.qtm import QtmMocap, QtmSettings, _diagnosis, _server_search, _session
from jointfit_protocols.qtm import QtmEvent
from jointfit_simulators.devices import QtmServer, RigidBodyAsset, TextServer
from tests.drivers.motion_capture.mocap_run import MocapRun
from tests.drivers.qtm.serving import POSE, SHANK, THIGH, made, served

if TYPE_CHECKING:
    from jointfit_daemon.device_search import Finding

pytestmark = pytest.mark.real_time


def settings_of(port: int, **table: Any) -> QtmSettings:
    keys = {"driver": "qtm", "server": "127.0.0.1", "command_port": port, "silence_s": 0.5}
    return QtmSettings.model_validate(keys | table)


def run_of(server: QtmServer, **table: Any) -> MocapRun:
    return MocapRun(QtmMocap(settings_of(server.command_port, **table)))


async def refusal(port: int, **table: Any) -> Exception:
    driver = QtmMocap(settings_of(port, **table))
    with pytest.raises((DeviceLostError, DeviceMisconfiguredError)) as raised:
        async with asyncio.timeout(10):
            await driver.run(lambda _: None)
    return raised.value


@pytest.mark.parametrize("newest", [(1, 19), (1, 22), (1, 28)])
async def test_the_newest_version_of_both_sides_is_used(newest: tuple[int, int]) -> None:
    server = made(newest=newest)
    reading = run_of(server)
    async with served(server), reading.running():
        await reading.until(lambda: bool(reading.frames))
    chosen = min(newest, (1, 25))
    assert "QTM, real-time protocol {}.{}".format(*chosen) in reading.texts()
    assert reading.frames[0].layout.bodies == ("Thigh", "Shank")
    assert reading.frames[0].body_positions[0].tolist() == pytest.approx(POSE[0])


async def test_a_server_without_a_known_version_is_refused() -> None:
    server = made(newest=(1, 18))
    async with served(server, sends=False):
        error = await refusal(server.command_port)
    assert isinstance(error, DeviceMisconfiguredError)
    assert "1.19 to 1.25" in str(error)


async def test_an_eleventh_client_is_lost_and_not_misconfigured() -> None:
    """QTM accepts at most ten clients. The driver retries, because another client may end."""
    server = made(most_clients=0)
    async with served(server, sends=False):
        error = await refusal(server.command_port)
    assert isinstance(error, DeviceLostError)
    assert "Max number of clients" in str(error)


async def test_the_big_endian_port_is_recognized() -> None:
    """QTM has a port for big-endian clients. The error names the other port."""
    greeting = b"QTM RT Interface connected\0"
    server = TextServer(struct.pack(">II", 8 + len(greeting), 1) + greeting)
    task = asyncio.create_task(server.run())
    try:
        error = await refusal(server.command_port)
    finally:
        task.cancel()
        await asyncio.wait([task])
        server.unplug()
    assert isinstance(error, DeviceMisconfiguredError)
    assert f"set command_port = {server.command_port - 1}" in str(error)


async def test_the_driver_waits_for_a_measurement_and_resumes() -> None:
    server = made(camera_time=False)
    server.measuring = False
    reading = run_of(server)
    async with served(server), reading.running():
        await reading.until(lambda: any("waiting" in text for text in reading.texts()))
        await asyncio.sleep(0.8)  # longer than silence_s
        assert not reading.frames
        server.start_measurement()
        await reading.until(lambda: len(reading.frames) > 3)
        server.stop_measurement()
        await asyncio.sleep(0.8)
        server.start_measurement(QtmEvent.RT_FROM_FILE_STARTED)
        await reading.until(lambda: not reading.frames[-1].live)
    assert sum("time restarts" in text for text in reading.texts()) == 1


async def test_bodies_that_the_operator_reorders_remain_bound_by_name() -> None:
    server = made()
    reading = run_of(server, rigid_body={"thigh": "Thigh"})
    async with served(server), reading.running():
        await reading.until(lambda: len(reading.frames) > 3)
        server.set_bodies((SHANK, RigidBodyAsset("New", ("N1",), 3), THIGH))
        await reading.until(lambda: "New" in reading.frames[-1].layout.bodies)
    for frame in reading.frames:
        column = frame.layout.bodies.index("Thigh")
        assert frame.body_positions[column].tolist() == pytest.approx(POSE[0])


async def test_lost_repeated_and_reordered_datagrams_are_counted() -> None:
    server = made(loss=0.1, duplication=0.1, reordering=0.1)
    reading = run_of(server)
    async with served(server), reading.running():
        await reading.until(lambda: len(reading.frames) > 60)
    numbers = [frame.number for frame in reading.frames]
    assert numbers == sorted(set(numbers))
    assert reading.decoder.duplicates > 0
    assert reading.decoder.late > 0
    assert any("frames lost" in text for text in reading.texts())


async def test_damaged_frames_are_rejected_as_a_whole() -> None:
    server = made(hostile=0.3)
    reading = run_of(server)
    async with served(server), reading.running():
        await reading.until(lambda: len(reading.frames) > 30)
    assert reading.decoder.discarded_bytes > 0
    assert all(np.isfinite(frame.body_positions[0]).all() for frame in reading.frames)


# --- search and diagnosis -------------------------------------------------------------------------


async def test_a_named_host_answers_with_its_names() -> None:
    server = made()
    async with served(server):
        (found,) = await QtmMocap.find_servers(
            ["127.0.0.1"], broadcast=False, port=server.command_port, wait_s=5
        )
    assert (found.driver, found.application, found.protocol) == ("qtm", "QTM", "QTM RT 1.25")
    assert found.bodies == ("Thigh", "Shank")
    assert found.markers == ("T1", "T2", "T3", "S1")


async def test_a_port_without_a_server_has_no_answer() -> None:
    server = made()
    server.unplug()
    assert await QtmMocap.find_servers(
        ["127.0.0.1"], broadcast=False, port=server.command_port, wait_s=0.5
    ) == []  # fmt: skip


async def test_servers_of_a_network_announce_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_server_search, "DISCOVERY_PORT", 52_226)
    loopback = ("127.0.0.1", "127.0.0.1")
    monkeypatch.setattr(_server_search, "broadcast_networks", lambda: [loopback])
    server = made(discovery_port=52_226)
    async with served(server, sends=False):
        (found,) = await QtmMocap.find_servers([], broadcast=True, port=None, wait_s=0.3)
    assert (found.server, found.port) == ("127.0.0.1", server.command_port)
    assert found.version == "2026.1 (build 1)"


async def findings(port: int, **table: Any) -> list[Finding]:
    return await QtmMocap.diagnose(settings_of(port, **table), 0.4)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_diagnosis, "ANSWER_S", 0.5)
    monkeypatch.setattr(_session, "ANSWER_S", 0.5)
    monkeypatch.setattr("jointfit_drivers.motion_capture._reception.FRAMES_S", 0.2)


@pytest.mark.usefixtures("short")
async def test_a_stream_without_a_fault_is_the_only_finding() -> None:
    server = made()
    async with served(server):
        (found,) = await findings(server.command_port, rigid_body={"thigh": "Thigh"})
    assert found.level == "ok"
    assert "2 rigid bodies, 4 markers" in found.text


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"rigid_body": {"thigh": "Tigh"}}, "did you mean 'Thigh'"),
        ({"rigid_body": {"shank": "Shank"}}, "'Shank' of shank was not tracked"),
    ],
)
async def test_a_fault_of_the_content_is_named(table: dict[str, Any], text: str) -> None:
    server = made()
    async with served(server):
        (found,) = await findings(server.command_port, **table)
    assert text in found.text


@pytest.mark.usefixtures("short")
async def test_no_measurement_no_program_and_a_firewall_are_told_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    server = made()
    server.measuring = False
    async with served(server):
        (waiting,) = await findings(server.command_port)
        server.measuring = True
        monkeypatch.setattr(_session, "_DATA_TYPES", frozenset())  # no datagram passes
        (firewall,) = await findings(server.command_port)
    (absent,) = await findings(server.command_port)
    assert "no measurement" in waiting.text
    assert "a firewall drops" in firewall.text
    assert 'transport = "tcp"' in firewall.remedy
    assert "no program listens" in absent.text
