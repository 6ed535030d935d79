"""The same faults for the daemon and for other programs: ``make faults ARGS=--peers``.

A minimal publisher with aiomqtt is exposed to the faults of the broker, and gpsd to the faults of
serial input. All programs run at the same time as the daemon, and each fault affects all of them
at the same time.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiomqtt

from tests.broker_fixture import HOST, chosen_broker
from tests.faults import gpsd_peer
from tests.faults.gateway import BASE, running_gateway
from tests.faults.peer_table import DAEMON, FLOOD_S, FREQUENT, RESULTS, slower_than_a_peer, table_of
from tests.faults.run import PAGE, render, stored

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.faults.gateway import Gateway
    from tests.faults.gpsd_peer import GpsdPeer

PAUSES_S = {"aiomqtt, pause of 5 s": 5.0, FREQUENT: 0.2}
"""Pause of each publisher after an error, s; 5 s is the value in the documentation of aiomqtt."""
OUTAGE_S = 1.0
BYTES_PER_S = 92_160
"""Rate of a line of 921 600 baud, bytes/s."""

Figures = dict[str, dict[str, list[float]]]
"""Times of each program in seconds, by fault and program."""


class MessageTimes:
    """Subscriber that stores the last arrival time of each topic; it reconnects within 10 ms."""

    def __init__(self, port: int, topics: dict[str, str]) -> None:
        self._port, self._names = port, {topic: name for name, topic in topics.items()}
        self.arrived_s: dict[str, float] = defaultdict(float)
        """Monotonic time of the last message of each program, s."""

    async def run(self) -> None:
        """Receive messages until cancelled."""
        while True:
            with contextlib.suppress(aiomqtt.MqttError):
                async with aiomqtt.Client(HOST, self._port, timeout=2.0) as client:
                    for topic in self._names:
                        await client.subscribe(topic)
                    async for message in client.messages:
                        self.arrived_s[self._names[str(message.topic)]] = time.monotonic()
            await asyncio.sleep(0.01)

    async def recovered(self, limit_s: float) -> dict[str, float]:
        """Wait for a message of every program; return the elapsed time of each, s."""
        began_s, found = time.monotonic(), dict[str, float]()
        async with asyncio.timeout(limit_s):
            while len(found) < len(self._names):
                for name in set(self._names.values()) - found.keys():
                    if self.arrived_s[name] > began_s:
                        found[name] = self.arrived_s[name] - began_s
                await asyncio.sleep(0.005)
        return found


@contextlib.asynccontextmanager
async def publishers(port: int) -> AsyncIterator[dict[str, asyncio.subprocess.Process]]:
    """Run the publishers that are compared with the daemon; yield their processes by name."""
    found = {}
    try:
        for number, (name, pause_s) in enumerate(PAUSES_S.items()):
            found[name] = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "tests.faults.aiomqtt_publisher",
                HOST, str(port), f"peer/{number}", str(pause_s),
                stdout=asyncio.subprocess.PIPE,
            )  # fmt: skip
        yield found
    finally:
        for process in found.values():
            process.kill()
            await process.wait()


async def meet_broker_faults(gateway: Gateway, repeat: int, found: Figures) -> None:
    """Kill the broker for one to two seconds, `repeat` times; then freeze it.

    The broker is frozen until the daemon and all publishers have detected the loss.
    """
    topics = {name: f"peer/{number}" for number, name in enumerate(PAUSES_S)}
    port = gateway.broker.port
    times = MessageTimes(port, topics | {DAEMON: f"{BASE}/pose"})
    task = asyncio.create_task(times.run())
    try:
        async with publishers(port) as processes:
            await times.recovered(20.0)
            for _ in range(repeat):
                gateway.broker.stop()
                # With a random duration, the outage ends at any instant of a publisher's pause.
                await asyncio.sleep(OUTAGE_S + random.random())
                gateway.broker.start()
                for name, value_s in (await times.recovered(30.0)).items():
                    found["publishing after the broker returned"][name].append(value_s)

            await asyncio.gather(*map(_drain, processes.values()))
            gateway.broker.freeze()
            try:
                noticed = await asyncio.gather(
                    gateway.disconnected(), *map(_next_error, processes.values())
                )
            finally:
                gateway.broker.thaw()
            for name, value_s in zip((DAEMON, *processes), noticed, strict=True):
                found["frozen broker noticed"][name].append(value_s)
    finally:
        task.cancel()
        await asyncio.wait([task])


async def _drain(process: asyncio.subprocess.Process) -> None:
    """Read the errors that a publisher has printed so far."""
    assert process.stdout is not None
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(0.5):
            while await process.stdout.readline():
                pass


async def _next_error(process: asyncio.subprocess.Process) -> float:
    """Wait until a publisher reports an error; return the elapsed time, s."""
    began_s = time.monotonic()
    assert process.stdout is not None
    async with asyncio.timeout(300.0):
        assert await process.stdout.readline()
    return time.monotonic() - began_s


async def meet_serial_faults(gateway: Gateway, gpsd: GpsdPeer, repeat: int, found: Figures) -> None:
    """Unplug a sensor and the receiver of gpsd for a second, `repeat` times."""
    device = gateway.sensors["S1"].device
    for _ in range(repeat):
        device.unplug()
        gpsd.line.unplug()
        await asyncio.sleep(OUTAGE_S)
        device.plug()
        await gpsd.plug()
        values = await asyncio.gather(gateway.used("S1", "S2"), gpsd.next_report())
        for name, value_s in zip((DAEMON, "gpsd"), values, strict=True):
            found["data after a device was plugged in again"][name].append(value_s)


async def flood_gpsd(gpsd: GpsdPeer) -> dict[str, float]:
    """Fill a line of 921 600 baud with fixes; return the number of fixes and of reports."""
    gpsd.sending = False
    await asyncio.sleep(OUTAGE_S)
    before, number = gpsd.reports, 0
    rate_hz = BYTES_PER_S / len(gpsd_peer.fix(0, 0.001))
    began_s = time.monotonic()
    while (now_s := time.monotonic() - began_s) < FLOOD_S:
        while number < now_s * rate_hz and gpsd.line.write(gpsd_peer.fix(number, 1.0 / rate_hz)):
            number += 1
        await asyncio.sleep(0.001)
    await asyncio.sleep(1.0)
    return {"sent": number, "received": gpsd.reports - before}


async def compare(folder: Path, repeat: int) -> dict[str, Any]:
    """Run all faults; return times by fault and program, and the counts of the flood."""
    found: Figures = defaultdict(lambda: defaultdict(list))
    broker = chosen_broker()(folder)
    broker.start()
    counts = {}
    try:
        async with running_gateway(folder, broker) as gateway:
            if (reason := gpsd_peer.missing()) is None:
                async with gpsd_peer.running_gpsd(folder) as gpsd:
                    await meet_serial_faults(gateway, gpsd, repeat, found)
                    counts = await flood_gpsd(gpsd)
            else:
                print(f"gpsd: skipped: {reason}")
            await meet_broker_faults(gateway, repeat, found)
    finally:
        broker.stop()
    return {"times_s": found, "gpsd_flood": counts}


def compare_with_peers(repeat: int, *, store: bool) -> int:
    """Run all faults and print the table; return 1 if a peer recovers sooner than the daemon."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)  # as root, gpsd changes to a user of its own
        results = asyncio.run(compare(Path(name), repeat))
    print(table_of(results))
    if store:
        RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", "utf-8")
        PAGE.write_text(render(stored()), "utf-8")
    slower = slower_than_a_peer(results)
    print("\n".join(f"slower than a peer: {fault}" for fault in slower) or "never slower")
    return 1 if slower else 0
