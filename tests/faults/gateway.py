"""Gateways for fault scenarios: simulated devices, broker, daemon and listener.

Three kinds of gateways exist. The kind ``serial`` has two serial sensors. The kind ``all`` also has
a sensor on CAN and cameras. The kind ``host`` has two serial sensors, and runs in a mount namespace
with a small disk for recordings, a clock that can be stepped, and writes that can be delayed.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import os
import random
import shutil
import signal
import struct
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.child_processes import ChildProcess, daemon
from jointfit_simulators.devices import XbusDevice
from tests.broker_fixture import HOST, address, free_port
from tests.faults.hardware import Cameras, CanSensor
from tests.limb_model.plain_calibration import plain_calibration
from tests.system.station import Listener, broker, sensors_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    from tests.broker_fixture import Broker
    from tests.faults.scenario import Kind

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
host = "{host}"
port = {port}
base = "{base}"
health_s = 0.2
[metrics]
listen = "{metrics}"
[recording]
directory = "{folder}/recordings"
"""
MORE = """
[can.can0]
interface = "slcan"
channel = "{folder}/can"
[[imu]]
id = "S3"
segment = "thigh"
driver = "xcdi"
can = "can0"
[mocap]
driver = "natnet"
server = "127.0.0.1"
command_port = {mocap}
silence_s = 0.5
markers.thigh = ["T1", "T2", "T3"]
"""
INJECTED = Path(__file__).parent / "injected"
"""Folder of the module that steps the clock of a daemon and delays its writes."""
DISK_MB = 4
"""Size of the file system for recordings, MB."""

REQUEST_PAUSE_S = 0.15
"""Pause before each request, s."""


def no_namespace() -> str | None:
    """Return why this user cannot mount a private file system; None if the user can."""
    command = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"]
    if shutil.which("unshare") is None:
        return "unshare is not installed (Debian: apt install util-linux)"
    run = subprocess.run(command, capture_output=True, check=False)
    return None if run.returncode == 0 else "this kernel refuses mount namespaces to this user"


class Sensor:
    """A moving IMU on a serial line, with faults that a test can activate."""

    def __init__(self, link: Path) -> None:
        self.link, self.number = link, 0
        self.stuck_at: int | None = None
        """Number of the sample whose orientation is repeated; None while the sensor works."""
        self.resting = False
        """Whether the sensor rests, except for noise."""
        self.batch = 1
        """Number of samples that are sent together, as with the latency timer of an adapter."""
        self.corrupted_share = 0.0
        """Share of messages with one wrong bit."""
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
        angle = 1e-4 * math.sin(number) if self.resting else math.sin(2.0 * number * PERIOD_S)
        q = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
        self.device.push(round(self.number * PERIOD_S * 1e9), q)


@dataclass
class Gateway:
    """The running components, which a scenario disturbs and restores."""

    folder: Path
    broker: Broker
    listener: Listener
    metrics_port: int
    kind: Kind
    sensors: dict[str, Sensor] = field(default_factory=dict)
    child: ChildProcess | None = None
    _cameras: Cameras | None = None
    _can: CanSensor | None = None

    @property
    def cameras(self) -> Cameras:
        """The cameras of the gateway "all"."""
        assert self._cameras is not None
        return self._cameras

    @property
    def can(self) -> CanSensor:
        """The sensor on CAN of the gateway "all"."""
        assert self._can is not None
        return self._can

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
        """Process id of the daemon."""
        assert self.child is not None
        assert self.child.process is not None
        return self.child.process.pid

    async def start(self) -> float:
        """Start the daemon; return the time until all sensors contribute to poses, s."""
        await self.launch()
        return await self.used(*self.names)

    async def launch(self) -> None:
        """Start the process of the daemon."""
        child = daemon(self.folder, self.rig)
        if self.kind == "host":
            self.inject()
            disk = self.folder / "recordings"
            disk.mkdir(exist_ok=True)
            mount = f'mount -t tmpfs -o size={DISK_MB}m none "{disk}" && exec "$@"'
            child.arguments = ["unshare", "-rm", "sh", "-c", mount, "sh", *child.arguments]
            child.environment |= {
                "PYTHONPATH": str(INJECTED), "INJECTED_FAULTS": str(self.folder / "injected"),
            }  # fmt: skip
        self.child = await child.__aenter__()

    @property
    def names(self) -> tuple[str, ...]:
        """Sensors of the gateway."""
        return ("S1", "S2", "S3") if self.kind == "all" else ("S1", "S2")

    def inject(self, step_s: float = 0.0, write_s: float = 0.0) -> None:
        """Set the step of UNIX time and the delay of durable writes in the daemon, both in s."""
        path = self.folder / "injected"
        path.touch()
        with path.open("r+b") as file:
            file.write(struct.pack("<qd", round(step_s * 1e9), write_s))

    def in_namespace(self, path: Path) -> Path:
        """Return a path of the daemon's mount namespace."""
        return Path(f"/proc/{self.pid}/root{path}")

    def rest(self, *, resting: bool) -> None:
        """Make the serial sensors rest or move."""
        for sensor in self.sensors.values():
            sensor.resting = resting

    def reload(self) -> None:
        """Make the daemon load rig.toml again."""
        os.kill(self.pid, signal.SIGHUP)

    async def request(self, name: str, **arguments: object) -> dict[str, Any]:
        """Send a request; return the answer."""
        assert self.listener.client is not None
        # Without the pause, fast scenarios would exceed the limit of ten requests per second.
        await asyncio.sleep(REQUEST_PAUSE_S)
        answer: dict[str, Any] = await self.listener.client.request(name, arguments)
        return answer

    async def start_fit(self) -> set[int]:
        """Start a static phase at rest, and wait until its fit runs; return the process ids."""
        self.rest(resting=True)
        await asyncio.sleep(0.5)
        answer = await self.request("calibrate", phase="static", seconds=2.0, force=True)
        assert answer["status"] == "accepted", answer
        async with asyncio.timeout(30.0):
            while not (workers := _children(self.pid)):
                await asyncio.sleep(0.002)
        return workers

    @contextlib.contextmanager
    def other_broker(self, other: Broker) -> Iterator[None]:
        """Replace the broker by another broker during the block."""
        self.broker.stop()
        other.start()
        try:
            yield
        finally:
            other.stop()
            self.broker.start()

    @contextlib.asynccontextmanager
    async def other_server(
        self, serve: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
    ) -> AsyncIterator[None]:
        """Replace the broker by a server that serves the daemon's connections."""
        self.broker.stop()
        port = self.broker.port
        try:
            async with await asyncio.start_server(serve, HOST, port, reuse_address=True):
                yield
        finally:
            self.broker.start()

    async def logged(self, text: str, since: int = 0) -> float:
        """Wait for a text in the log after `since` characters; return the elapsed time, s."""
        return await self.seconds(lambda: text in self.log[since:])

    async def device(self, name: str) -> dict[str, Any]:
        """Return the current counters of a device."""
        found: dict[str, Any] = (await self.health())["devices"][name]
        return found

    async def streaming(self, name: str) -> float:
        """Wait until a device is online and sends; return the elapsed time, s."""
        began_s = time.monotonic()
        await self.listener.connected({name})
        before = self.listener.latest["bridge/health"]["devices"][name]["received"]
        await self.listener.until(
            lambda: self.listener.latest["bridge/health"]["devices"][name]["received"] > before
        )
        return time.monotonic() - began_s

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
        """Wait for another pose with these sensors; return the elapsed time, s."""
        count = len(self.listener.poses)
        return await self.seconds(
            lambda: any(
                sensors_in(pose).issuperset(sensors) for pose in self.listener.poses[count:][-20:]
            )
        )

    async def seconds(self, condition: Callable[[], object]) -> float:
        """Wait for a condition; return the elapsed time, s."""
        began_s = time.monotonic()
        await self.listener.until(condition)
        return time.monotonic() - began_s

    async def disconnected(self) -> float:
        """Wait until the daemon detects the loss of the broker; return the elapsed time, s."""
        began_s = time.monotonic()
        async with asyncio.timeout(30.0):
            while b"\njointfit_mqtt_connected 1" in await self._metrics():
                await asyncio.sleep(0.02)
        return time.monotonic() - began_s

    async def link_dropped(self) -> float:
        """Wait until the daemon drops a message to the broker; return the elapsed time, s."""
        began_s, name = time.monotonic(), b"\njointfit_mqtt_dropped_messages_total "

        async def dropped() -> int:
            return int(float((await self._metrics()).split(name)[1].split()[0]))

        before = await dropped()
        async with asyncio.timeout(60.0):
            while await dropped() == before:
                await asyncio.sleep(0.05)
        return time.monotonic() - began_s

    async def fresh_pose(self) -> float:
        """Wait for a pose with all sensors, at most 0.5 s old; return the elapsed time, s."""
        return await self.seconds(
            lambda: any(
                time.time() - pose["t_us"] * 1e-6 < 0.5 and sensors_in(pose).issuperset(self.names)
                for pose in self.listener.poses[-3:]
            )
        )

    async def remove_old_recordings(self) -> None:
        """Stop and delete all recordings, and start a new one, because the disk is small."""
        await self.request("record", action="stop")
        folder = self.in_namespace(self.folder / "recordings")
        for path in folder.iterdir():
            path.unlink()
        answer = await self.request("record", action="start")
        assert answer["status"] == "ok", answer

    async def _metrics(self) -> bytes:
        reader, writer = await asyncio.open_connection(HOST, self.metrics_port)
        try:
            writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
            return await reader.read()
        finally:
            writer.close()
            await writer.wait_closed()

    async def event(self, device: str, *parts: str) -> float:
        """Wait for another event of `device` with these parts; return the elapsed time, s."""
        self.listener.events.clear()
        return await self.seconds(lambda: self.listener.find_event(device, *parts))

    async def health(self) -> dict[str, Any]:
        """Return the second health message from now.

        The first one may contain values from before the call.
        """
        count = self.listener.healths
        await self.listener.until(lambda: self.listener.healths > count + 1)
        found: dict[str, Any] = self.listener.latest["bridge/health"]
        return found

    def pose_gap_s(self, since: int) -> float:
        """Return the longest time between poses received since number `since`, s."""
        t_us = [pose["t_us"] for pose in self.listener.poses[max(0, since - 1) :]]
        steps = [after - before for before, after in itertools.pairwise(t_us)]
        return max(steps, default=0) / 1e6


def _children(pid: int) -> set[int]:
    """Return the running child processes of a process."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            text = path.read_text("utf-8", "replace")
            if int(text.rpartition(")")[2].split()[1]) == pid:
                found.add(int(path.parent.name))
    return found


@contextlib.asynccontextmanager
async def running_gateway(
    folder: Path, chosen: Broker, kind: Kind = "serial"
) -> AsyncIterator[Gateway]:
    """Yield a gateway whose sensors contribute to poses."""
    metrics, cameras = free_port(), Cameras() if kind == "all" else None
    text = RIG.format(
        folder=folder, host=HOST, port=chosen.port, base=BASE, metrics=address(metrics)
    )
    if cameras is not None:
        text += MORE.format(folder=folder, mocap=cameras.server.command_port)
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    rig = load_rig(folder / "rig.toml")
    store = CalibrationStore(folder / "state" / "calibrations", rig.calibration_store)
    store.save(plain_calibration(rig.chain))
    listener = Listener(broker(chosen.port, BASE), TOPICS)
    gateway = Gateway(folder, chosen, listener, metrics, kind)
    gateway.sensors = {name: Sensor(folder / name) for name in ("S1", "S2")}
    tasks = [asyncio.create_task(sensor.run()) for sensor in gateway.sensors.values()]
    if cameras is not None:
        gateway._cameras, gateway._can = cameras, CanSensor(folder / "can")
        tasks += [asyncio.create_task(part.run()) for part in (cameras, gateway.can)]
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
