"""Latency of poses, compared with programs that only send: aiomqtt, and the Lab Streaming Layer.

While the daemon runs, its poses and the messages of both senders are received in turn in the same
process, so other work of the machine delays all of them equally.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from typing import TYPE_CHECKING, Any

import orjson
from aiomqtt import Client, ProtocolVersion

from bench.experiments.speed.gateway import played
from bench.framework.measurement import percentile, speed_experiment, timed_result
from bench.rigs.gateway import ROOT, Load, running_gateway

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bench.framework.experiment import Result
    from bench.rigs.gateway import Gateway

ROUNDS, QUICK_ROUNDS = 4, 1
ROUND_S, SETTLE_S = 4.0, 1.0
FIND_S = 10.0
"""Time limit to find the outlet, s."""
POSE, PUBLISHER, OUTLET = (
    "jointfitd: last sample to pose at a subscriber",
    "aiomqtt publisher to subscriber",
    "LSL outlet to inlet",
)


@contextlib.asynccontextmanager
async def sender(*words: str) -> AsyncIterator[None]:
    """Run a process that sends the time."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "bench.rigs.latency_peers", *words, cwd=ROOT
    )
    try:
        yield
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def latencies_of_poses(gateway: Gateway) -> list[float]:
    """Return the latencies of the poses of a round, ms."""
    gateway.heard.latencies_ms.clear()
    await asyncio.sleep(ROUND_S)
    return gateway.heard.latencies_ms[:]


async def latencies_of_publisher(port: int) -> list[float]:
    """Return the latencies of the messages of aiomqtt, ms."""
    found: list[float] = []
    async with (
        sender("mqtt", str(port), "peer/time"),
        Client("127.0.0.1", port, protocol=ProtocolVersion.V5) as client,
    ):
        await client.subscribe("peer/time")

        async def listen() -> None:
            async for message in client.messages:
                sent_ns = orjson.loads(message.payload)["t_ns"]
                found.append((time.time_ns() - sent_ns) / 1e6)

        listening = asyncio.create_task(listen())
        while not found:  # noqa: ASYNC110 - another task fills it
            await asyncio.sleep(0.05)
        await asyncio.sleep(SETTLE_S)
        found.clear()
        await asyncio.sleep(ROUND_S)
        listening.cancel()
        await asyncio.wait([listening])
    return found


async def latencies_of_outlet(pylsl: Any, name: str) -> list[float]:
    """Return the latencies of the samples of an outlet, ms."""

    def receive() -> list[float]:
        streams = pylsl.resolve_byprop("name", name, timeout=FIND_S)
        if not streams:
            return []
        inlet = pylsl.StreamInlet(streams[0])
        inlet.open_stream(timeout=FIND_S)
        found = []
        begin_s = time.monotonic() + SETTLE_S
        while (now_s := time.monotonic()) < begin_s + ROUND_S:
            sample, _ = inlet.pull_sample(timeout=1.0)
            if sample is not None and now_s > begin_s:
                found.append((time.time_ns() - sample[0]) / 1e6)
        inlet.close_stream()
        return found

    async with sender("lsl", name):
        return await asyncio.to_thread(receive)


async def run(folder: Path, port: int, rounds: int) -> dict[str, list[float]]:
    """Return the latencies of all rounds, ms."""
    found: dict[str, list[float]] = {POSE: [], PUBLISHER: [], OUTLET: []}
    try:
        import pylsl  # noqa: PLC0415 - its library is missing on some machines
    except (ImportError, RuntimeError, OSError) as missing:
        print(f"not run: {OUTLET}: {missing}", file=sys.stderr)
        pylsl = None
    async with running_gateway(folder, port, Load(100.0)) as gateway:
        for number in range(rounds):
            found[POSE] += await latencies_of_poses(gateway)
            found[PUBLISHER] += await latencies_of_publisher(port)
            if pylsl is not None:
                found[OUTLET] += await latencies_of_outlet(pylsl, f"{folder.name}-{number}")
    return found


def rows(quick: bool) -> list[Result]:
    """Return median and 99th percentile of each latency, and the ratio to the pose."""
    rounds = QUICK_ROUNDS if quick else ROUNDS
    found = played("mosquitto", lambda folder, port: run(folder, port, rounds))
    if found is None:
        return []
    rows = []
    for name, ms in found.items():
        if not ms:
            continue
        for share, word in ((0.5, "median"), (0.99, "p99")):
            ratio = percentile(ms, share) / percentile(found[POSE], share)
            note = f"{len(ms)} messages" + ("" if name == POSE else f"; {ratio:.2f} times the pose")
            rows.append(
                timed_result(f"{name}: {word}", round(percentile(ms, share), 2), "ms", note=note)
            )
    return rows


EXPERIMENTS = (
    speed_experiment(
        "latency-peers",
        "Processes: 4 × 100 Hz, against programs that only send messages of the same size",
        rows,
        in_short_run=False,
    ),
)
