"""Simulated gateways of a fleet: `python -m bench.rigs.fleet_gateways PORT TRAFFIC COUNT`.

Invariant: each gateway has its own connection. It sends the recorded messages of one real daemon at
their recorded times, with a time shift relative to the other gateways. After a loss of the
connection, it connects again as the daemon does, and sends its retained messages first. The process
prints a line when all gateways are connected. It ends when its input is closed, and prints its
counts as JSON.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sys
import time
from base64 import b64decode
from dataclasses import dataclass
from pathlib import Path

from bench.rigs.dashboard_viewers import packet, text

HOST = "127.0.0.1"
RETRY_S = (0.3, 0.6)
"""Time before another attempt to connect, s, as in the daemon."""
SKIPPED_S = 1.0
"""Delay above which a message is not sent, s. At the start, messages before the time shift of the
gateway are thus omitted."""
DUE_KEY = b'"completed_us":'
"""Key in poses. Its value is replaced by the time of sending, so that the station can measure
delays."""


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A recorded message of the daemon."""

    at_s: float
    """Time since the start of the recording, s; 0 for a retained message."""
    topic: str
    """Topic relative to the base topic."""
    payload: bytes
    retained: bool


@dataclass(slots=True)
class Sent:
    """Counts of the messages that all gateways wrote to their connections."""

    messages: int = 0
    octets: int = 0


def load_traffic(path: Path) -> tuple[float, list[RecordedMessage]]:
    """Return the duration of a recording, s, and its messages."""
    content = json.loads(path.read_text(encoding="utf-8"))
    messages = [
        RecordedMessage(at_s, topic, b64decode(payload), retained)
        for at_s, topic, payload, retained in content["messages"]
    ]
    return content["seconds"], messages


class SimulatedGateway:
    """One simulated gateway."""

    def __init__(self, port: int, number: int, sent: Sent) -> None:
        self._port, self._base, self._sent = port, f"jointfit/wearer-{number:02d}", sent
        self.connected = asyncio.Event()

    async def run(self, period_s: float, messages: list[RecordedMessage], shift_s: float) -> None:
        """Publish until cancelled."""
        retained = [message for message in messages if message.retained]
        stream = [message for message in messages if not message.retained]
        while True:
            try:
                await self._publish(retained, stream, period_s, shift_s)
            except OSError:
                await asyncio.sleep(random.uniform(*RETRY_S))  # noqa: S311 - no secret

    async def _publish(
        self,
        retained: list[RecordedMessage],
        stream: list[RecordedMessage],
        period_s: float,
        shift_s: float,
    ) -> None:
        reader, writer = await asyncio.open_connection(HOST, self._port)
        acknowledged = asyncio.create_task(self._read(reader))
        try:
            writer.write(packet(0x10, text("MQTT") + bytes([4, 2, 0, 60]) + text(self._base[9:])))
            for message in retained:
                self._write(writer, message)
            self.connected.set()

            began_s = time.monotonic() - shift_s
            while True:
                for message in stream:
                    late_s = time.monotonic() - began_s - message.at_s
                    if late_s < 0:
                        await asyncio.sleep(-late_s)
                    elif late_s > SKIPPED_S:
                        continue
                    await writer.drain()
                    if acknowledged.done():
                        acknowledged.result()
                    self._write(writer, message)
                began_s += period_s
        finally:
            acknowledged.cancel()
            writer.close()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while await reader.read(4096):
            pass
        raise ConnectionResetError

    def _write(self, writer: asyncio.StreamWriter, message: RecordedMessage) -> None:
        payload, flags = message.payload, 0x30 | message.retained
        if message.topic == "pose/ui":
            head, key, tail = payload.partition(DUE_KEY)
            payload = head + key + b"%d" % (time.time_ns() // 1000) + tail[16:]
        data = packet(flags, text(f"{self._base}/{message.topic}") + payload)
        writer.write(data)
        self._sent.messages += 1
        self._sent.octets += len(data)


async def run(port: int, traffic: Path, count: int) -> Sent:
    """Run gateways until the input is closed; return the total counts."""
    sent = Sent()
    period_s, messages = load_traffic(traffic)
    gateways = [SimulatedGateway(port, number, sent) for number in range(count)]
    tasks = [
        asyncio.create_task(gateway.run(period_s, messages, period_s * number / count))
        for number, gateway in enumerate(gateways)
    ]
    for gateway in gateways:
        await gateway.connected.wait()
    print("ready", flush=True)

    await asyncio.to_thread(sys.stdin.read)
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    return sent


def main() -> None:
    """Run the gateways that the arguments describe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("traffic", type=Path)
    parser.add_argument("count", type=int)
    options = parser.parse_args()
    sent = asyncio.run(run(options.port, options.traffic, options.count))
    print(json.dumps({"messages": sent.messages, "bytes": sent.octets}))


if __name__ == "__main__":
    main()
