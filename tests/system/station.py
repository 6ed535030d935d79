"""A complete gateway for tests: simulated devices, the daemon process, and an MQTT listener.

Retained messages can arrive before queued events, and events before queued poses and health
messages. A test that has waited for one message therefore waits for each other message that it
checks.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.calibration import CalibrationTrial, SensorTrack
from jointfit_daemon.calibration.phases import fit_static
from jointfit_daemon.calibration.phases._static_pose import fit_static_only
from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import MqttSettings, load_rig
from jointfit_daemon.outputs.mqtt import BrokerLostError, MqttClient
from jointfit_daemon.tools.calibrate import PhaseTracker
from jointfit_daemon.tools.child_processes import ChildProcess, Simulator
from jointfit_daemon.tools.child_processes import daemon as daemon_child
from jointfit_daemon.tools.child_processes import simulator as simulator_child
from tests.broker_fixture import HOST

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Collection
    from pathlib import Path

    from jointfit_simulators.scene import Scene

BASE = "jointfit/station"
SENSORS = ("S1", "S2", "S3", "S4")
OUTCOMES = ("used", "decimated", "idle", "late", "duplicate", "dropped")
TOPICS = (
    "pose", "calibration", "bridge/state", "bridge/info", "bridge/event", "bridge/health",
    "device/+/availability",
)  # fmt: skip
RECONNECT_S = 0.1
"""Time before the listener connects again, s."""
PATIENCE_S = 60.0
"""Time limit for a message, s. On an idle machine, it arrives within 3 s."""
FIT_PATIENCE_S = 150.0
"""Time limit for a fit, s. It needs 10 s on an idle machine, and its process has a low priority."""


def broker(port: int, base: str = BASE) -> MqttSettings:
    """Return the settings of a client for the test's broker."""
    return MqttSettings(host=HOST, port=port, base=base)


def load_factor() -> float:
    """Return the factor by which the load of this machine slows a process down, at least 1.

    The factor is the number of runnable processes per core. Time limits of a claim about the daemon
    apply to an idle machine and are multiplied by this factor.
    """
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@dataclass
class Listener:
    """Messages that the daemon published since the listener connected.

    The listener reconnects when the broker restarts.
    """

    settings: MqttSettings
    topics: tuple[str, ...] = TOPICS
    poses: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    latest: dict[str, Any] = field(default_factory=dict)
    """Newest payload by topic."""
    healths: int = 0
    """Number of health messages received."""
    client: MqttClient | None = None
    calibration: PhaseTracker = field(default_factory=lambda: PhaseTracker(lambda *_: None))

    async def run(self) -> None:
        """Receive messages until cancelled."""
        while True:
            with contextlib.suppress(BrokerLostError):
                async with MqttClient(self.settings) as self.client:
                    await self.client.subscribe(*self.topics)
                    async for topic, payload in self.client.messages():
                        self._take(topic, payload)
            self.client = None
            await asyncio.sleep(RECONNECT_S)

    def _take(self, topic: str, payload: Any) -> None:
        self.latest[topic] = payload
        if topic == "pose":
            self.poses.append(payload)
        elif topic == "bridge/event":
            self.events.append(payload)
        elif topic == "bridge/health":
            self.healths += 1
        elif topic == "calibration":
            self.calibration.on_status(payload)

    @property
    def online(self) -> set[str]:
        """Devices whose availability is online."""
        return {
            topic.split("/")[1]
            for topic, payload in self.latest.items()
            if topic.endswith("/availability") and payload == {"v": 1, "state": "online"}
        }

    def find_event(self, device: str, *parts: str) -> dict[str, Any] | None:
        """Return the first event of `device` whose text contains all `parts`, if any."""
        for event in self.events:
            if event["id"] == device and all(part in event["text"] for part in parts):
                return event
        return None

    def format_events(self) -> str:
        """Return all events, one per line, for the messages of failed assertions."""
        return "\n".join(f"{e['level']} {e['kind']} {e['id']}: {e['text']}" for e in self.events)

    async def until(self, condition: Callable[[], object], within_s: float = PATIENCE_S) -> None:
        """Wait for a condition; the error message lists the events."""
        try:
            async with asyncio.timeout(within_s):
                while not condition():
                    await asyncio.sleep(0.01)
        except TimeoutError:
            raise AssertionError(
                f"not within {within_s:g} s; online: {sorted(self.online)};"
                f" health: {self.latest.get('bridge/health')}\n{self.format_events()}"
            ) from None

    async def connected(self, devices: Collection[str], within_s: float = PATIENCE_S) -> None:
        """Wait until all of these devices are online."""
        await self.until(lambda: self.online.issuperset(devices), within_s)

    async def disconnected(self, devices: Collection[str], within_s: float = PATIENCE_S) -> None:
        """Wait until none of these devices is online."""
        await self.until(lambda: self.online.isdisjoint(devices), within_s)

    async def event(self, device: str, *parts: str, within_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait for an event of `device` whose text contains all `parts`; return it."""
        await self.until(lambda: self.find_event(device, *parts), within_s)
        event = self.find_event(device, *parts)
        assert event is not None
        return event

    async def more_poses(
        self, count: int = 20, within_s: float = PATIENCE_S
    ) -> list[dict[str, Any]]:
        """Wait for `count` more poses; return exactly these poses."""
        before = len(self.poses)
        await self.until(lambda: len(self.poses) >= before + count, within_s)
        return self.poses[before : before + count]

    async def poses_after(self, t_us: int, count: int = 1) -> list[dict[str, Any]]:
        """Wait for `count` poses later than `t_us` (UNIX time, µs); return exactly these poses."""

        def later() -> list[dict[str, Any]]:
            return [pose for pose in self.poses[-20 * count :] if pose["t_us"] > t_us]

        await self.until(lambda: len(later()) >= count)
        return later()[:count]

    async def health(
        self, condition: Callable[[dict[str, Any]], object] = lambda _: True
    ) -> dict[str, Any]:
        """Wait for another health message whose devices meet `condition`; return its devices."""
        before = self.healths
        await self.until(
            lambda: self.healths > before and condition(self.latest["bridge/health"]["devices"])
        )
        devices: dict[str, Any] = self.latest["bridge/health"]["devices"]
        return devices

    async def final_health(self) -> dict[str, Any]:
        """Wait for health with all devices offline and no waiting samples; return the devices."""
        await self.until(lambda: not self.online)
        return await self.health(
            lambda devices: not any(d["online"] or d["pending"] for d in devices.values())
        )

    async def phase(self, name: str, seconds: float, *, force: bool = False) -> Any:
        """Run one phase of a calibration; return the status that ended it."""
        assert self.client is not None
        self.calibration.begin()
        request = {"phase": name, "seconds": seconds, "force": force}
        answer = await self.client.request("calibrate", request)
        assert answer["status"] == "accepted", answer
        async with asyncio.timeout(seconds + FIT_PATIENCE_S):
            return await self.calibration.wait_for_end(name)


def sensors_in(pose: dict[str, Any]) -> set[str]:
    """Return the sensors that contributed to a pose."""
    return {sensor for part in pose["segments"].values() for sensor in part["used"]}


def knee_angles(poses: list[dict[str, Any]]) -> list[float]:
    """Return the known inner angles of the knee, deg."""
    angles = [pose["joints"]["knee"]["inner_deg"] for pose in poses]
    return [angle for angle in angles if angle is not None and math.isfinite(angle)]


@contextlib.asynccontextmanager
async def listening(
    port: int, base: str = BASE, topics: tuple[str, ...] = TOPICS
) -> AsyncIterator[Listener]:
    """Yield a listener."""
    listener = Listener(broker(port, base), topics)
    task = asyncio.create_task(listener.run(), name="listener")
    try:
        yield listener
    finally:
        task.cancel()
        await asyncio.wait([task])


@dataclass
class Station:
    """A simulator process and a daemon process on its rig."""

    folder: Path
    port: int
    options: tuple[str, ...] = ()
    more_toml: str = ""
    """Text that is appended to the rig.toml of the simulator."""
    mqtt_toml: str = ""
    """Text that is added to the table ``[mqtt]``."""

    @property
    def rig(self) -> Path:
        """Path of the daemon's rig.toml."""
        return self.folder / "daemon.toml"

    @property
    def log(self) -> str:
        """Log of the daemon."""
        return (self.folder / "daemon.log").read_text("utf-8", "replace")

    def write_rig(self, *changes: tuple[str, str]) -> None:
        """Write the daemon's rig: the simulator's rig with each (old, new) replaced once."""
        text = (self.folder / "rig.toml").read_text(encoding="utf-8") + self.more_toml
        text = text.replace("[mqtt]\n", f"[mqtt]\nhealth_s = 0.5\n{self.mqtt_toml}")
        for old, new in changes:
            assert text.count(old) == 1, (old, text)
            text = text.replace(old, new)
        self.rig.write_text(text, encoding="utf-8")
        load_rig(self.rig)

    @contextlib.asynccontextmanager
    async def simulator(self, *changes: tuple[str, str]) -> AsyncIterator[Simulator]:
        """Yield the simulator once it is ready and the daemon's rig is written."""
        async with simulator_child(self.folder, self.port, BASE, self.options) as child:
            await child.ready()
            self.write_rig(*changes)
            yield child

    @contextlib.asynccontextmanager
    async def daemon(self) -> AsyncIterator[ChildProcess]:
        """Yield the daemon process."""
        async with daemon_child(self.folder, self.rig) as child:
            yield child


@contextlib.asynccontextmanager
async def in_this_process(scene: Scene) -> AsyncIterator[None]:
    """Run simulated devices in this process, so a test can change them; raise their errors."""
    ready = asyncio.Event()
    task = asyncio.create_task(scene.run(lambda _: ready.set()), name="scene")
    try:
        await ready.wait()
        yield
    finally:
        scene.stop()
        await asyncio.wait([task])
        task.result()


@contextlib.asynccontextmanager
async def running(
    station: Station, within_s: float = PATIENCE_S
) -> AsyncIterator[tuple[Simulator, ChildProcess, Listener]]:
    """Yield simulator, daemon and listener once all sources are online."""
    async with (
        station.simulator() as simulator,
        station.daemon() as daemon,
        listening(station.port) as listener,
    ):
        await listener.connected({source.id for source in load_rig(station.rig).sources}, within_s)
        yield simulator, daemon, listener


async def stopped(
    daemon: ChildProcess, number: signal.Signals = signal.SIGTERM
) -> tuple[int, float]:
    """Send a signal; return the exit code and the time until the exit, s."""
    assert daemon.process is not None
    began = time.monotonic()
    daemon.process.send_signal(number)
    async with asyncio.timeout(PATIENCE_S):
        code = await daemon.process.wait()
    return code, time.monotonic() - began


def restore_signals() -> None:
    """Enable the stop signals in a child process, which nohup and `&` may have disabled."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def hang_up(daemon: ChildProcess) -> None:
    """Send SIGHUP, so the daemon reloads its rig."""
    assert daemon.process is not None
    daemon.process.send_signal(signal.SIGHUP)


def unbalanced(devices: dict[str, Any]) -> dict[str, dict[str, int]]:
    """Return the counters of devices with pending samples or with a wrong sum of outcomes."""
    return {
        name: {key: device[key] for key in ("received", *OUTCOMES, "pending")}
        for name, device in devices.items()
        if device["received"] != sum(device[key] for key in OUTCOMES) or device["pending"]
    }


def store_calibration(rig_file: Path, state: Path) -> None:
    """Store a static calibration of sensors that are aligned with their segments."""
    rig = load_rig(rig_file)
    t_ns = np.arange(400, dtype=np.int64) * 10_000_000
    still = np.tile((1.0, 0.0, 0.0, 0.0), (len(t_ns), 1))
    names = [name for group in rig.chain.sensors for name in group]
    trial = CalibrationTrial({name: SensorTrack(t_ns, still) for name in names}, None)
    pose = fit_static(trial, rig.calibration, rig.chain)
    CalibrationStore(state / "calibrations", rig.calibration_store).save(
        fit_static_only(pose, None, rig.chain)
    )
