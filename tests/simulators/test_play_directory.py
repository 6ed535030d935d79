"""Directory lock, stored command port, and motions selected by the calibration phase."""

from __future__ import annotations

import asyncio
import socket
import sys
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.embedded_broker import embedded_broker, free_port
from jointfit_simulators.body import LIMBS
from jointfit_simulators.devices import LOOPBACK
from jointfit_simulators.scene import PhaseFollower, RigOptions, play_directory
from jointfit_simulators.scene._phase_follower import MOTIONS_OF_PHASES
from jointfit_simulators.scene._play_directory import DirectoryInUseError, PortInUseError
from tests.system.station import PATIENCE_S, Station, listening, running

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def used_port() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind((LOOPBACK, 0))
        yield holder.getsockname()[1]


def test_second_simulator_in_a_directory_is_rejected_with_process_and_remedy(
    tmp_path: Path,
) -> None:
    with (
        play_directory(tmp_path),
        pytest.raises(DirectoryInUseError, match=r"process \d+\).*kill \d+.*--directory"),
        play_directory(tmp_path),
    ):
        pass
    with play_directory(tmp_path):  # the first block released the lock
        pass


def test_command_port_of_the_previous_run_is_used_if_free(tmp_path: Path, used_port: int) -> None:
    with play_directory(tmp_path) as first:
        assert first.command_port(None) == 0
        first.store_command_port(used_port)
    with play_directory(tmp_path) as second:
        assert second.command_port(None) == 0  # in use by another program
        second.store_command_port(None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        free = probe.getsockname()[1]
    with play_directory(tmp_path) as third:
        third.store_command_port(free)
    with play_directory(tmp_path) as fourth:
        assert fourth.command_port(None) == free
        assert fourth.command_port(free) == free


@pytest.mark.parametrize("port", [0, -1, 70_000])
def test_invalid_port_number_is_rejected(tmp_path: Path, port: int) -> None:
    with play_directory(tmp_path) as directory, pytest.raises(PortInUseError, match="1 to 65535"):
        directory.command_port(port)


def test_requested_port_in_use_is_rejected_with_a_remedy(tmp_path: Path, used_port: int) -> None:
    with (
        play_directory(tmp_path) as directory,
        pytest.raises(PortInUseError, match="select another"),
    ):
        directory.command_port(used_port)


@pytest.mark.parametrize("content", [b"", b"\xff", b"[]", b'{"command_port":"x"}', b"9" * 5000])
def test_invalid_state_file_is_ignored(tmp_path: Path, content: bytes) -> None:
    (tmp_path / ".jointfit-sim.json").write_bytes(content)
    with play_directory(tmp_path) as directory:
        assert directory.command_port(None) == 0


async def rejected(*options: str) -> tuple[int | None, str]:
    """Run ``jointfit-sim play``, expected to exit at once; return exit code and output."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "jointfit_simulators", "play", *options),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(PATIENCE_S):
        output, _ = await process.communicate()
    process._transport.close()  # type: ignore[attr-defined]  # asyncio leaves it to the garbage collector
    return process.returncode, output.decode()


def links_in(folder: Path) -> dict[str, Path]:
    """Return the pseudo-terminals to which the links in a folder point, by name of the link."""
    return {path.name: path.readlink() for path in folder.glob("tty*")}


@pytest.mark.system
@pytest.mark.timeout(240)
async def test_running_daemon_reconnects_to_the_cameras_of_a_restarted_simulator(
    tmp_path: Path,
) -> None:
    async with AsyncExitStack() as stack:
        port = stack.enter_context(embedded_broker(tmp_path))
        station = Station(tmp_path, port)
        first = await stack.enter_async_context(station.simulator())

        link_targets = links_in(tmp_path)
        code, output = await rejected("--directory", str(tmp_path))
        assert code == 2, output
        assert "uses this directory" in output
        assert links_in(tmp_path) == link_targets

        await stack.enter_async_context(station.daemon())
        listener = await stack.enter_async_context(listening(port))
        await listener.connected({"mocap"})
        assert first.process is not None
        first.process.terminate()
        await first.process.wait()
        await listener.until(lambda: "mocap" not in listener.online)
        await stack.enter_async_context(station.simulator())
        await listener.connected({"mocap"})


@pytest.mark.system
@pytest.mark.timeout(240)
async def test_motion_follows_the_phase_published_by_the_daemon(tmp_path: Path) -> None:
    with embedded_broker(tmp_path) as port:
        station = Station(tmp_path, port, options=("--follow", "--programme", "walk"))
        async with running(station) as (simulator, _, listener):
            assert listener.client is not None

            async def motion() -> str:
                async with asyncio.timeout(PATIENCE_S):
                    while "motion" not in (line := await simulator.answer()):
                        pass
                return str(line["motion"])

            assert await motion() == "stand"  # the daemon is not calibrated
            await listener.client.request("calibrate", {"phase": "align", "seconds": 20})
            assert await motion() == "plate"
            await listener.client.request("calibrate", {"phase": "abort"})
            assert await motion() == "stand"
            async with asyncio.timeout(PATIENCE_S):  # a motion starts with the next block
                await simulator.send_command("status")
                while await motion() != "stand":
                    await simulator.send_command("status")


@pytest.mark.parametrize("limb", LIMBS)
def test_all_motions_of_phases_exist(limb: str) -> None:
    played = {name for motions in MOTIONS_OF_PHASES[limb].values() for name, _ in motions}
    assert played <= set(LIMBS[limb].motions)


async def test_phase_with_several_motions_repeats_them_until_the_next_phase(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    short = {"functional": (("functional", 0.05), ("walk", 0.05)), "align": (("plate", 0.05),)}
    monkeypatch.setitem(MOTIONS_OF_PHASES, "leg", short)
    played: list[str] = []
    follower = PhaseFollower(RigOptions(mqtt_port=free_port()), played.append, lambda _: None)
    following = asyncio.create_task(follower.run())
    for status in (b'{"phase":"functional"}', b'{"phase":"functional"}', b"[]", b"{", b"\xff"):
        follower._receive(status)
    async with asyncio.timeout(PATIENCE_S):
        while len(played) < 5:
            await asyncio.sleep(0.01)
    assert played[:5] == ["functional", "walk", "functional", "walk", "functional"]
    follower._receive(b'{"phase":"aligned"}')
    await asyncio.sleep(0.2)
    assert played[-1] == "stand"
    following.cancel()
    await asyncio.wait([following])
