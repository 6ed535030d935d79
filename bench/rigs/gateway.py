"""The daemon between simulated devices and a broker, with latencies measured at a subscriber.

Invariant: four processes exchange only bytes. The processes are ``jointfit-sim``, jointfitd, a
broker, and this process, which only subscribes. ``jointfit-sim`` simulates two IMUs on
pseudo-terminals, two on an SLCAN adapter on a pseudo-terminal, and a NatNet server. The daemon uses
a stored calibration of the simulated subject.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import sys
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import loop_s
from bench.rigs.request_flood import SECONDS
from bench.subjects.simulated_wearer import bench_rig, fitted
from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import MqttSettings, load_rig
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.tools.child_processes import daemon, simulator

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.tools.child_processes import ChildProcess, Simulator

SETTLE_S = 4.0
"""Time in which the clocks converge, s. It is not part of the measurement."""
CONNECT_S, END_S = 40.0, 20.0
FLOOD_START_S = 0.5
"""Time in which the flooding process starts and connects, s. It is not part of the measurement."""
ROOT = Path(__file__).resolve().parents[2]
COMPILED = ROOT / "build" / "compiled"
OUTCOMES = ("used", "decimated", "idle", "late", "duplicate", "dropped", "pending")
TOPICS = ("pose", "bridge/health", "bridge/state", "device/+/availability")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Load:
    """Samples that the simulated devices send."""

    rate_hz: float
    mocap_hz: float = 100.0

    @property
    def options(self) -> list[str]:
        """Options of ``jointfit-sim``."""
        knobs = ("--set", f"mocap_hz={self.mocap_hz:g}")
        return ["--rate", f"{self.rate_hz:g}", "--programme", "walk", *knobs]


@dataclass(slots=True)
class ReceivedMessages:
    """Messages that the subscriber received."""

    latencies_ms: list[float] = field(default_factory=list)
    online: set[str] = field(default_factory=set)
    health: dict[str, Any] = field(default_factory=dict)
    pose: dict[str, Any] = field(default_factory=dict)
    first_pose_s: float | None = None
    running_s: float | None = None
    """Monotonic time of the first message on ``bridge/state``, s. `first_pose_s` is the monotonic
    time of the first pose."""

    async def listen(self, client: MqttClient) -> None:
        async for topic, payload in client.messages():
            if topic == "pose":
                now_us = time.time_ns() / 1e3
                self.latencies_ms.append((now_us - payload["completed_us"]) / 1e3)
                self.pose = payload
                self.first_pose_s = self.first_pose_s or time.monotonic()
            elif topic == "bridge/health":
                self.health = payload
            elif topic == "bridge/state":
                self.running_s = self.running_s or time.monotonic()
            else:
                there = payload == {"v": 1, "state": "online"}
                (self.online.add if there else self.online.discard)(topic.split("/")[1])


@dataclass(frozen=True, slots=True)
class Figures:
    """Results of one run."""

    latencies_ms: list[float]
    """Latency of every frame, ms: receipt of the pose minus arrival of the sample that completed
    the frame."""
    seconds: float
    cpu_s: float
    """CPU time of the daemon during the measurement, s."""
    loop_s: float
    """CPU time of a fixed computation after the measurement, s, which shows the speed of the
    machine."""
    waited_s: float
    """Time in which the daemon was ready to run but had no processor core, because the machine was
    loaded, s."""
    rss_mb: float
    unaccounted: int
    """Number of samples that were sent but not received, or that are neither pending nor have an
    outcome."""
    dropped: int
    """Number of samples with the outcome ``dropped``."""
    received: int
    running_s: float
    first_pose_s: float
    """Time from the start of the process to the first pose, s. `running_s` is the time from the
    start to ``online`` at the broker."""


@cache
def calibration() -> Calibration:
    """Return the calibration of the simulated subject (seed 1)."""
    return fitted(bench_rig())


@dataclass(frozen=True, slots=True)
class FloodFigures:
    """Latencies of all frames of one run, before and during a flood of requests."""

    quiet_ms: list[float]
    flooded_ms: list[float]
    quiet_cpu_s: float
    flooded_cpu_s: float
    """CPU time of the daemon during the flood, s. `quiet_cpu_s` is its CPU time before the flood.
    """
    seconds: float
    """Duration of each part, s."""
    requests: int
    """Number of requests that were sent during the flood."""
    ignored: int
    """Number of requests that the daemon counted as ignored."""


@dataclass(frozen=True, slots=True)
class Gateway:
    """Running devices, daemon and subscriber."""

    hardware: Simulator
    pid: int
    base: str
    """Base topic of the rig."""
    heard: ReceivedMessages
    began_s: float
    """Monotonic start time of the daemon."""


async def run(
    folder: Path, port: int, load: Load, seconds: float, *, compiled: bool = False
) -> Figures:
    """Start all processes, wait, measure for `seconds`, stop the devices, and count all samples."""
    async with running_gateway(folder, port, load, compiled=compiled) as gateway:
        heard = gateway.heard
        measured = await _measure(gateway.pid, heard, seconds)
        sent = (await gateway.hardware.quit())["sent"]
        devices = await _last_health(heard)
        return Figures(
            *measured,
            unaccounted(sent, devices),
            sum(device["dropped"] for device in devices.values()),
            sum(device["received"] for device in devices.values()),
            (heard.running_s or 0.0) - gateway.began_s,
            (heard.first_pose_s or 0.0) - gateway.began_s,
        )


async def run_flooded(folder: Path, port: int, load: Load) -> FloodFigures:
    """Start all processes, wait, and measure without requests, then under a flood of requests."""
    async with running_gateway(folder, port, load) as gateway:
        heard, pid = gateway.heard, gateway.pid
        quiet_ms, _, quiet_cpu, *_ = await _measure(pid, heard, SECONDS)

        async with flooder(port, f"jointfit/{folder.name}", SECONDS) as flood:
            await asyncio.sleep(FLOOD_START_S)
            flooded_ms, seconds, flooded_cpu, *_ = await _measure(pid, heard, SECONDS)
            sent = await flood
        heard.health.clear()
        async with asyncio.timeout(END_S):
            while not heard.health:  # noqa: ASYNC110 - another task sets it
                await asyncio.sleep(0.05)
        ignored = heard.health["link"]["ignored_requests"]
        return FloodFigures(quiet_ms, flooded_ms, quiet_cpu, flooded_cpu, seconds, sent, ignored)


@asynccontextmanager
async def flooder(port: int, base: str, seconds: float) -> AsyncIterator[asyncio.Task[int]]:
    """Run a process that floods the daemon; yield a task with its number of requests."""
    words = ("-m", "bench.rigs.request_flood", str(port), base, "--seconds", str(seconds))
    process = await asyncio.create_subprocess_exec(
        sys.executable, *words, cwd=ROOT, stdout=asyncio.subprocess.PIPE
    )

    async def ended() -> int:
        said, _ = await process.communicate()
        report = json.loads(said)
        assert report["seconds"] < seconds + 2.0, f"the flood was too slow: {report}"
        sent: int = report["sent"]
        return sent

    task = asyncio.create_task(ended(), name="flooder")
    try:
        yield task
    finally:
        if process.returncode is None:
            process.kill()
        await asyncio.wait([task])


@asynccontextmanager
async def running_gateway(
    folder: Path, port: int, load: Load, *, compiled: bool = False
) -> AsyncIterator[Gateway]:
    """Start devices, subscriber and daemon; wait until all sources are online.

    With `compiled`, the daemon uses the modules in build/compiled.
    """
    base = f"jointfit/{folder.name}"
    CalibrationStore(folder / "state" / "calibrations", "demo").save(calibration())
    async with simulator(folder, port, base, load.options) as hardware:
        rig_file = Path((await hardware.ready())["rig"])
        rig = load_rig(rig_file)
        assert calibration().fits(rig.chain)
        wanted = {source.id for source in rig.sources}
        async with subscriber(rig.mqtt) as heard:
            began = time.monotonic()
            async with daemon_variant(folder, rig_file, compiled=compiled) as process:
                assert process.process is not None
                async with asyncio.timeout(CONNECT_S):
                    while not heard.online >= wanted:
                        process.check()
                        await asyncio.sleep(0.05)
                await asyncio.sleep(SETTLE_S)
                yield Gateway(hardware, process.process.pid, base, heard, began)


def daemon_variant(folder: Path, rig_file: Path, *, compiled: bool) -> ChildProcess:
    """Return the process of the daemon, which runs the Python files or the compiled modules."""
    process = daemon(folder, rig_file)
    if compiled:
        paths = (str(COMPILED), str(ROOT))
        # PYTHONSAFEPATH prevents Python from importing the checkout in the current folder.
        process.environment |= {"PYTHONPATH": os.pathsep.join(paths), "PYTHONSAFEPATH": "1"}
    return process


@asynccontextmanager
async def subscriber(settings: MqttSettings) -> AsyncIterator[ReceivedMessages]:
    """Collect the messages of the daemon during the block; yield them."""
    heard = ReceivedMessages()
    async with MqttClient(settings) as client:
        await client.subscribe(*TOPICS)
        listening = asyncio.create_task(heard.listen(client), name="subscriber")
        try:
            yield heard
        finally:
            listening.cancel()
            await asyncio.wait([listening])


async def _measure(
    pid: int, heard: ReceivedMessages, seconds: float
) -> tuple[list[float], float, float, float, float, float]:
    gc.collect()
    gc.freeze()  # garbage collection would add latency
    heard.latencies_ms.clear()
    began_s, began_cpu, began_wait = time.monotonic(), cpu_s(pid), waited_s(pid)
    await asyncio.sleep(seconds)
    latencies, took_s = heard.latencies_ms[:], time.monotonic() - began_s
    spent, waited = cpu_s(pid) - began_cpu, waited_s(pid) - began_wait
    assert heard.pose["mode"] == "imu+mocap", heard.pose
    assert heard.pose["sync"] == "locked", heard.pose
    return latencies, took_s, spent, loop_s(), waited, rss_mb(pid)


async def _last_health(heard: ReceivedMessages) -> dict[str, Any]:
    """Wait until the health message reports all sources offline: no sample is then in transit."""
    async with asyncio.timeout(END_S):
        while any(  # noqa: ASYNC110 - the content of a message is the condition
            device["online"] for device in heard.health["devices"].values()
        ):
            await asyncio.sleep(0.05)
    devices: dict[str, Any] = heard.health["devices"]
    return devices


def unaccounted(sent: dict[str, int], devices: dict[str, dict[str, Any]]) -> int:
    """Return the number of samples that were not received, or that are without an outcome.

    Pending samples, and samples with the outcome ``dropped``, are not counted.
    """
    lost = 0
    for name, device in devices.items():
        received = device["received"]
        lost += abs(sent[name] - received) + abs(received - sum(device[v] for v in OUTCOMES))
    return lost


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process, user and system, s."""
    text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    fields = text.rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def waited_s(pid: int) -> float:
    """Return the time in which a process's main thread waited for a processor core, s."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="utf-8").split()[1]) / 1e9
    except OSError:  # this kernel has no such file
        return float("nan")


def rss_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    return float("nan")
