"""The program jointfit-sim as a process: ready line, commands on stdin, final counts."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from collections import Counter
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.config._load import load_rig
from jointfit_daemon.model import Corrupt, ImuSample, MocapFrame
from jointfit_simulators.__main__ import COMMANDS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from jointfit_daemon.config._rig import Source
    from jointfit_daemon.model import Chunk, Decoded

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


class Sim:
    """A running ``jointfit-sim play``."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    async def line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        async with asyncio.timeout(60):
            found: dict[str, Any] = json.loads(await self.process.stdout.readline())
        return found

    async def send(self, command: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{command}\n".encode())
        await self.process.stdin.drain()

    async def ask(self, command: str = "status") -> dict[str, Any]:
        await self.send(command)
        return await self.line()


def close_pipes(process: Any) -> None:
    """Close the pipes that asyncio leaves to the garbage collector, which runs after the test."""
    process._transport.close()


@asynccontextmanager
async def playing(directory: Path, *options: str) -> AsyncIterator[tuple[Sim, dict[str, Any]]]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "jointfit_simulators", "play",
        "--directory", str(directory), *options,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    sim = Sim(process)
    try:
        yield sim, await sim.line()
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()
        close_pipes(process)


async def listen(source: Source, received: list[Decoded]) -> None:
    driver = source.driver_class(source.settings)
    decoder = driver.decoder()

    def emit(chunk: Chunk) -> None:
        received.extend(decoder.feed(chunk))

    await driver.run(emit)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.05)


def counts(received: dict[str, list[Decoded]]) -> dict[str, int]:
    return {
        name: sum(isinstance(item, ImuSample | MocapFrame) for item in items)
        for name, items in received.items()
    }


async def unreceived(sim: Sim, received: dict[str, list[Decoded]]) -> Counter[str]:
    """Pause until no message is in transit; return the numbers of samples sent and not received.

    The pause is shorter than the silence after which a driver reports a lost device.
    """
    await sim.send("pause on")
    await asyncio.sleep(0.4)
    status = await sim.ask()
    await sim.send("pause off")
    sent = Counter({name: device["sent"] for name, device in status["devices"].items()})
    sent["mocap"] = status["mocap"]["sent"]
    sent.subtract(counts(received))
    return sent


async def test_drivers_receive_every_sample_sent(tmp_path: Path) -> None:
    async with playing(tmp_path, "--programme", "walk") as (sim, ready):
        rig = load_rig(tmp_path / "rig.toml")
        assert ready["ready"] is True
        assert ready["rig"] == str(tmp_path / "rig.toml")
        received: dict[str, list[Decoded]] = {source.id: [] for source in rig.sources}
        async with asyncio.TaskGroup() as tasks:
            listening = [
                tasks.create_task(listen(source, received[source.id])) for source in rig.sources
            ]
            await until(lambda: min(counts(received).values()) > 0)  # after all handshakes
            at_first = await unreceived(sim, received)
            before = counts(received)
            await until(lambda: min(n - before[name] for name, n in counts(received).items()) > 200)
            at_last = await unreceived(sim, received)
            for task in listening:
                task.cancel()
        await sim.send("quit")
        account = await sim.line()
        assert await sim.process.wait() == 0
    assert at_first == at_last
    assert all(at_first[name] <= 3 for name in ("S1", "S2", "S3", "S4"))
    assert min(n - before[name] for name, n in counts(received).items()) > 200
    assert sum(account["dropped_out"].values()) > 0
    assert sum(account["refused"].values()) == 0
    assert not any(isinstance(item, Corrupt) for items in received.values() for item in items)


async def test_measurements_without_errors_equal_the_ground_truth(tmp_path: Path) -> None:
    async with playing(tmp_path, "--perfect", "--programme", "squat", "--rate", "200") as (sim, _):
        rig = load_rig(tmp_path / "rig.toml")
        received: dict[str, list[Decoded]] = {source.id: [] for source in rig.sources}
        async with asyncio.TaskGroup() as tasks:
            listening = [
                tasks.create_task(listen(source, received[source.id])) for source in rig.sources
            ]
            await asyncio.sleep(3.0)
            for task in listening:
                task.cancel()
        await sim.send("quit")
        await sim.line()
    first, *truth = map(json.loads, (tmp_path / "truth.jsonl").read_text().splitlines())
    t_ns = np.array([row["t_ns"] for row in truth])
    for name, segment in first["sensors"].items():
        samples = [item for item in received[name] if isinstance(item, ImuSample)]
        boot = first["clocks"][name]["boot_ns"]
        ticks = np.unwrap([float(s.ticks or 0) for s in samples], period=2.0**32)
        wraps = np.round((samples[0].arrival_ns - boot) / 1e5 / 2**32 - ticks[0] / 2**32)
        at_ns = boot + (ticks + wraps * 2**32) * 1e5
        measured = Rotation.from_quat([s.q_world_sensor for s in samples], scalar_first=True)
        nearest = np.clip(np.searchsorted(t_ns, at_ns), 1, len(t_ns) - 1)
        nearest -= at_ns - t_ns[nearest - 1] < t_ns[nearest] - at_ns
        expected = Rotation.from_quat(
            [truth[i]["q_world_segment"][segment] for i in nearest], scalar_first=True
        )
        apart = np.degrees((measured.inv() * expected).magnitude())
        assert apart.max() < 1.5  # rotation of a squat in 5 ms
        assert np.median(apart) < 0.5


async def test_commands_change_the_scene_and_invalid_ones_are_reported(tmp_path: Path) -> None:
    async with playing(tmp_path, "--no-mocap") as (sim, _):
        assert (await sim.ask())["motion"] == "stand"
        await sim.send("play walk")
        await sim.send("unplug S1")
        await asyncio.sleep(0.5)
        assert (await sim.ask())["motion"] == "walk"
        assert not (tmp_path / "ttyS1").is_symlink()
        await sim.send("plug S1")
        await sim.ask()
        assert (tmp_path / "ttyS1").exists()
        await sim.send("unplug can0")
        await sim.ask()
        assert not (tmp_path / "ttyCAN0").is_symlink()
        for command, hint in (
            ("hop", "no command 'hop'"),
            ("play hop", "no motion 'hop'"),
            ("unplug S9", "no sensor 'S9'"),
            ("occlude maybe", "expected on or"),
            ("slip S1 far", "expected a sensor and a number"),
            ("drift S9 1", "no sensor 'S9'"),
        ):
            assert hint in (await sim.ask(command))["error"]
        for command in ("stick S3", "free S3", "slip S3 5", "drift S3 -1.5"):
            await sim.send(command)
        for command in ("reboot S3", "occlude on", "mocap stop", "mocap start", "pause off", ""):
            await sim.send(command)
        assert (await sim.ask())["motion"] == "walk"


async def test_ground_truth_is_written_in_real_time(tmp_path: Path) -> None:
    async with playing(tmp_path, "--no-mocap", "--programme", "stand:1,walk") as _:
        await asyncio.sleep(2.5)
        lines = (tmp_path / "truth.jsonl").read_text().splitlines()
        now_ns = time.monotonic_ns()
        rows = [json.loads(line) for line in lines[1:-1]]
        assert rows[-1]["t_ns"] <= now_ns
        assert now_ns - rows[-1]["t_ns"] < 500_000_000  # 0.2 s, on an idle machine
        steps = np.diff([row["t_ns"] for row in rows])
        assert set(steps.tolist()) == {10_000_000}
        assert {row["motion"] for row in rows} == {"stand", "walk"}
        first = json.loads(lines[0])
        assert first["lengths_m"] == {"thigh": 0.42, "shank": 0.4}
        assert first["knobs"]["dropout"] == 0.005
        hip, knee, ankle = (np.array(rows[-1]["joint_m"][j]) for j in ("hip", "knee", "ankle"))
        assert np.linalg.norm(hip - knee) == pytest.approx(0.42)
        assert np.linalg.norm(knee - ankle) == pytest.approx(0.40)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_signal_stops_the_simulator_with_its_counts(
    tmp_path: Path, number: signal.Signals
) -> None:
    async with playing(tmp_path) as (sim, _):
        os.kill(sim.process.pid, number)
        assert set(await sim.line()) == {"sent", "dropped_out", "refused", "unheard"}
        assert await sim.process.wait() == 0
    assert not (tmp_path / "ttyS1").is_symlink()


async def test_recorded_trial_plays_from_the_command_line(
    tmp_path: Path, shared_data: Path
) -> None:
    semireal = shared_data / "semireal_knee4imu"
    files = [semireal / "squats1.npz", semireal / "static_bias.json"]
    markers = shared_data / "opencap_subject4/trc/squats1.trc"
    options = ["--perfect", "--programme", "stand:1,trial", "--trial", *map(str, [*files, markers])]
    async with playing(tmp_path, *options):
        rig = load_rig(tmp_path / "rig.toml")
        assert dict(rig.calibration.rigid_bodies) == {"thigh": "Thigh", "shank": "Shank"}
        assert rig.calibration.markers["foot"] == ("r_calc", "r_5meta", "r_toe")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "dropot=1"], "did you mean 'dropout'"),
        (["--programme", "hop:3"], "no motion 'hop'"),
        (["--trial", "nothing.npz"], "nothing.npz"),
    ],
)
async def test_invalid_command_line_exits_with_2_and_a_reason(
    tmp_path: Path, options: list[str], message: str
) -> None:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "jointfit_simulators", "play", "--directory", str(tmp_path), *options,
        stdin=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    _, message_bytes = await process.communicate()
    close_pipes(process)
    assert process.returncode == 2
    assert message in message_bytes.decode()


def test_help_of_play_lists_every_command() -> None:
    listed = {word.strip(",") for line in COMMANDS.splitlines() for word in line.split()}
    assert {"hide", "show", "exchange", "occlude", "unplug"} <= listed
