"""A gateway for fault scenarios: two simulated sensors, broker, daemon and listener."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import random
import signal
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.child_processes import ChildProcess, daemon
from jointfit_simulators.devices import XbusDevice
from tests.broker_fixture import free_port
from tests.limb_model.plain_calibration import plain_calibration
from tests.system.station import Listener, broker, sensors_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

BASE = "jointfit/faults"
PERIOD_S = 0.01
TOPICS = (
    "pose", "calibration", "bridge/state", "bridge/event", "bridge/health", "device/+/availability",
)  # fmt: skip
RIG = """
[rig]
name = "faults"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "{folder}/S1"
[[imu]]
id = "S2"
segment = "thigh"
driver = "xbus"
port = "{folder}/S2"
[mqtt]
host = "127.0.0.1"
port = {port}
base = "{base}"
health_s = 0.2
[metrics]
listen = "127.0.0.1:{metrics}"
[recording]
directory = "{folder}/recordings"
"""


class Sensor:
    """A moving IMU on a serial line, with faults that can be switched on."""

    def __init__(self, link: Path) -> None:
        self.link, self.number = link, 0
        self.stuck_at: int | None = None
        """Number of the sample whose orientation is repeated; None while the sensor works."""
        self.batch = 1
        """Samples that are sent together, as an adapter with a latency timer does."""
        self.corrupted_share = 0.0
        """Share of messages in which one bit is wrong."""
        self._random = random.Random(1)
        self.device = XbusDevice(link, wire_noise=self._noise)

    def _noise(self, data: bytes) -> bytes:
        if self._random.random() >= self.corrupted_share:
            return data
        place, bit = self._random.randrange(len(data)), 1 << self._random.randrange(8)
        return data[:place] + bytes([data[place] ^ bit]) + data[place + 1 :]

    async def run(self) -> None:
        """Serve the line and send samples until cancelled."""
        serving = asyncio.create_task(self.device.run())
        try:
            began_s = time.monotonic()
            first = self.number
            while True:
                due = first + int((time.monotonic() - began_s) / PERIOD_S)
                if due - self.number >= self.batch:
                    while self.number < due:
                        self.number += 1
                        self._push()
                await asyncio.sleep(PERIOD_S / 2)
        finally:
            serving.cancel()
            await asyncio.wait([serving])
            self.device.unplug()

    def _push(self) -> None:
        number = self.number if self.stuck_at is None else self.stuck_at
        angle = math.sin(2.0 * number * PERIOD_S)
        q = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
        self.device.push(round(self.number * PERIOD_S * 1e9), q)


@dataclass
class Gateway:
    """The running parts, which a scenario breaks and repairs."""

    folder: Path
    broker: Broker
    listener: Listener
    metrics_port: int
    sensors: dict[str, Sensor] = field(default_factory=dict)
    child: ChildProcess | None = None

    @property
    def rig(self) -> Path:
        """Path of rig.toml."""
        return self.folder / "rig.toml"

    @property
    def log(self) -> str:
        """Log of the daemon."""
        return (self.folder / "daemon.log").read_text("utf-8", "replace")

    @property
    def pid(self) -> int:
        """Number of the daemon's process."""
        assert self.child is not None
        assert self.child.process is not None
        return self.child.process.pid

    async def start(self) -> float:
        """Start the daemon; return the time until both sensors contribute to poses, s."""
        self.child = await daemon(self.folder, self.rig).__aenter__()
        return await self.used("S1", "S2")

    def unfinished_recordings(self) -> set[str]:
        """Return the names of recordings that are being written or need a repair."""
        return {path.name for path in (self.folder / "recordings").glob("*.part")}

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> float:
        """Stop the daemon by a signal; return the time until its exit, s."""
        assert self.child is not None
        assert self.child.process is not None
        began_s = time.monotonic()
        with contextlib.suppress(ProcessLookupError):
            self.child.process.send_signal(number)
        await self.child.__aexit__()
        self.child = None
        return time.monotonic() - began_s

    async def used(self, *sensors: str) -> float:
        """Wait for a further pose with these sensors; return the time that it took, s."""
        count = len(self.listener.poses)
        return await self.seconds(
            lambda: any(
                sensors_in(pose).issuperset(sensors) for pose in self.listener.poses[count:][-20:]
            )
        )

    async def seconds(self, condition: Callable[[], object]) -> float:
        """Wait for a condition; return the time that it took, s."""
        began_s = time.monotonic()
        await self.listener.until(condition)
        return time.monotonic() - began_s

    async def disconnected(self) -> float:
        """Wait until the daemon knows that the broker is lost; return the time, s."""
        began_s = time.monotonic()
        async with asyncio.timeout(30.0):
            while b"\njointfit_mqtt_connected 1" in await self._metrics():
                await asyncio.sleep(0.02)
        return time.monotonic() - began_s

    async def _metrics(self) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.metrics_port)
        try:
            writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
            return await reader.read()
        finally:
            writer.close()
            await writer.wait_closed()

    async def event(self, device: str, *parts: str) -> float:
        """Wait for a further event; return the time that it took, s."""
        self.listener.events.clear()
        return await self.seconds(lambda: self.listener.find_event(device, *parts))

    async def health(self) -> dict[str, Any]:
        """Return the next health message but one: all of it is of now."""
        count = self.listener.healths
        await self.listener.until(lambda: self.listener.healths > count + 1)
        found: dict[str, Any] = self.listener.latest["bridge/health"]
        return found

    def pose_gap_s(self, since: int) -> float:
        """Return the longest time between instants of poses received since number `since`, s."""
        t_us = [pose["t_us"] for pose in self.listener.poses[max(0, since - 1) :]]
        steps = [after - before for before, after in itertools.pairwise(t_us)]
        return max(steps, default=0) / 1e6


@contextlib.asynccontextmanager
async def running_gateway(folder: Path, chosen: Broker) -> AsyncIterator[Gateway]:
    """Yield a gateway whose two sensors contribute to poses."""
    metrics = free_port()
    text = RIG.format(folder=folder, port=chosen.port, base=BASE, metrics=metrics)
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    rig = load_rig(folder / "rig.toml")
    store = CalibrationStore(folder / "state" / "calibrations", rig.calibration_store)
    store.save(plain_calibration(rig.chain))
    listener = Listener(broker(chosen.port, BASE), TOPICS)
    gateway = Gateway(folder, chosen, listener, metrics)
    gateway.sensors = {name: Sensor(folder / name) for name in ("S1", "S2")}
    tasks = [asyncio.create_task(sensor.run()) for sensor in gateway.sensors.values()]
    tasks.append(asyncio.create_task(listener.run(), name="listener"))
    try:
        await gateway.start()
        yield gateway
    finally:
        if gateway.child is not None:
            await gateway.stop()
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
