"""A fleet of simulated gateways, one broker, and one station that subscribes to all gateways.

Invariant: the messages were recorded from a real daemon for some seconds. Broker, gateways and
station are separate processes. The station is this process.
"""

from __future__ import annotations

import asyncio
import json
import re
import sys
import time
from base64 import b64encode
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

from bench.rigs.dashboard_viewers import packet, text
from bench.rigs.fleet_gateways import DUE_KEY, HOST
from bench.rigs.gateway import Load, cpu_s, rss_mb, running_gateway

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.broker_fixture import MosquittoBroker

ROOT = Path(__file__).resolve().parents[2]
FORWARDED = (
    "pose/ui", "joint/*", "bridge/state", "bridge/info", "bridge/health", "bridge/event",
    "bridge/response/*", "calibration", "device/*",
)  # fmt: skip
"""Topics that the broker of a gateway forwards, as in examples/fleet/gateway-bridge.conf."""
ALL = ("*",)
WARM_S, LIMIT_S = 2.0, 60.0
_DUE = re.compile(re.escape(DUE_KEY) + rb"(\d{16})")


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages of one gateway."""

    path: Path
    """File with recorded messages for `bench.rigs.fleet_gateways`."""
    messages_s: float
    bytes_s: float
    retained: int


@dataclass(slots=True)
class Station:
    """A subscriber to the topics of all gateways."""

    messages: int = 0
    latencies_ms: list[float] = field(default_factory=list)
    online: set[bytes] = field(default_factory=set)

    async def listen(self, port: int) -> None:
        """Receive until cancelled."""
        reader, writer = await asyncio.open_connection(HOST, port, limit=1 << 20)
        try:
            writer.write(packet(0x10, text("MQTT") + bytes([4, 2, 0, 0]) + text("station")))
            writer.write(packet(0x82, bytes([0, 1]) + text("jointfit/#") + b"\0"))
            while True:
                kind = (await reader.readexactly(1))[0]
                content = await reader.readexactly(await _length(reader))
                if kind >> 4 == 3:
                    size = int.from_bytes(content[:2])
                    self._receive(content[2 : 2 + size], content[2 + size :])
                    self.messages += not kind & 1  # omit retained messages
        finally:
            writer.close()

    def _receive(self, topic: bytes, payload: bytes) -> None:
        if topic.endswith(b"/pose/ui"):
            if (sent := _DUE.search(payload)) is not None:
                self.latencies_ms.append(time.time_ns() / 1e6 - int(sent[1]) / 1e3)
        elif topic.endswith(b"/bridge/state"):
            self.online.add(topic)


async def _length(reader: asyncio.StreamReader) -> int:
    """Return the length of an MQTT packet: 7 bits per byte, the lowest bits first."""
    length = shift = 0
    while True:
        byte = (await reader.readexactly(1))[0]
        length |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return length


@dataclass(frozen=True, slots=True)
class FleetFigures:
    """Results of one run."""

    messages_s: float
    latencies_ms: list[float]
    lost: int
    """Number of messages that the gateways sent and the station did not receive."""
    broker_pct: float
    broker_mb: float
    back_s: float
    """Time from the restart of the broker without stored state until all gateways are online, s."""


async def record_traffic(
    folder: Path, port: int, seconds: float, selections: dict[str, tuple[str, ...]]
) -> dict[str, Traffic]:
    """Record the messages of one daemon; write one file for each selection of topics."""
    messages: list[tuple[float, str, bytes, bool]] = []
    async with running_gateway(folder, port, Load(100.0)) as gateway:
        reader, writer = await asyncio.open_connection(HOST, port, limit=1 << 20)
        writer.write(packet(0x10, text("MQTT") + bytes([4, 2, 0, 0]) + text("recorder")))
        writer.write(packet(0x82, bytes([0, 1]) + text(f"{gateway.base}/#") + b"\0"))
        began_s = time.monotonic()
        while (now_s := time.monotonic() - began_s) < seconds:
            kind = (await reader.readexactly(1))[0]
            content = await reader.readexactly(await _length(reader))
            if kind >> 4 == 3:
                size = int.from_bytes(content[:2])
                topic = content[2 : 2 + size].decode().removeprefix(f"{gateway.base}/")
                retained = bool(kind & 1)
                messages.append((0.0 if retained else now_s, topic, content[2 + size :], retained))
        writer.close()

    found = {}
    for name, topics in selections.items():
        chosen = [m for m in messages if any(fnmatchcase(m[1], topic) for topic in topics)]
        path = folder / f"{name}.json"
        rows = [(at, topic, b64encode(load).decode(), kept) for at, topic, load, kept in chosen]
        path.write_text(json.dumps({"seconds": seconds, "messages": rows}), encoding="utf-8")
        stream = [message for message in chosen if not message[3]]
        octets = sum(len(topic) + len(payload) + 30 for _, topic, payload, _ in stream)
        retained_count = len(chosen) - len(stream)
        found[name] = Traffic(path, len(stream) / seconds, octets / seconds, retained_count)
    return found


async def measure_fleet(
    broker: MosquittoBroker, traffic: Traffic, count: int, seconds: float
) -> FleetFigures:
    """Run `count` gateways and one station for `seconds`, then restart the broker."""
    station = Station()
    listening = asyncio.create_task(station.listen(broker.port))
    async with _gateways(broker.port, traffic.path, count) as process:
        await asyncio.sleep(WARM_S)
        station.latencies_ms.clear()
        before, cpu, began_s = station.messages, cpu_s(broker.pid), time.monotonic()
        await asyncio.sleep(seconds)
        took_s = time.monotonic() - began_s
        rate = (station.messages - before) / took_s
        share, memory = 100.0 * (cpu_s(broker.pid) - cpu) / took_s, rss_mb(broker.pid)
        latencies = station.latencies_ms[:]
        sent = json.loads((await process.communicate(b""))[0].splitlines()[-1])
        await asyncio.sleep(1.0)
        lost = sent["messages"] - station.messages
    listening.cancel()
    await asyncio.wait([listening])
    return FleetFigures(
        rate, latencies, lost, share, memory, await _restart(broker, traffic, count)
    )


async def _restart(broker: MosquittoBroker, traffic: Traffic, count: int) -> float:
    """Restart the broker; return the time until all gateways are online, s."""
    async with _gateways(broker.port, traffic.path, count):
        broker.stop()
        broker.start()
        began_s, station = time.monotonic(), Station()
        listening = asyncio.create_task(station.listen(broker.port))
        async with asyncio.timeout(LIMIT_S):
            while len(station.online) < count:  # noqa: ASYNC110 - counted by another task
                await asyncio.sleep(0.01)
        listening.cancel()
        await asyncio.wait([listening])
        return time.monotonic() - began_s


@asynccontextmanager
async def _gateways(
    port: int, traffic: Path, count: int
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run simulated gateways in another process during the ``async with`` block."""
    words = ("-m", "bench.rigs.fleet_gateways", str(port), str(traffic), str(count))
    process = await asyncio.create_subprocess_exec(
        sys.executable, *words, cwd=ROOT,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        async with asyncio.timeout(LIMIT_S):
            await process.stdout.readline()
        yield process
    finally:
        if process.returncode is None:
            process.kill()
            await process.communicate()
