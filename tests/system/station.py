"""A whole gateway for tests: virtual hardware, the real daemon, and somebody who listens."""

from __future__ import annotations

import asyncio
import contextlib
import math
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

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from jointfit_simulators.scene import Scene

BASE = "jointfit/station"
SENSORS = ("S1", "S2", "S3", "S4")
VERDICTS = ("used", "decimated", "idle", "late", "duplicate", "dropped")
TOPICS = (
    "pose", "calibration", "bridge/state", "bridge/info", "bridge/event", "bridge/health",
    "device/+/availability",
)  # fmt: skip
RETRY_S = 0.1


def broker(port: int, base: str = BASE) -> MqttSettings:
    """Return where a test's broker is."""
    return MqttSettings(host="127.0.0.1", port=port, base=base)


@dataclass
class Listener:
    """Everything the daemon said since the listener came, across restarts of the broker."""

    settings: MqttSettings
    poses: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    latest: dict[str, Any] = field(default_factory=dict)
    """Newest payload by topic."""
    healths: int = 0
    client: MqttClient | None = None
    calibration: PhaseTracker = field(default_factory=lambda: PhaseTracker(lambda *_: None))

    async def run(self) -> None:
        """Listen until cancelled."""
        while True:
            with contextlib.suppress(BrokerLostError):
                async with MqttClient(self.settings) as self.client:
                    await self.client.subscribe(*TOPICS)
                    async for topic, payload in self.client.messages():
                        self._take(topic, payload)
            self.client = None
            await asyncio.sleep(RETRY_S)

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
        """Devices that are available."""
        return {
            topic.split("/")[1]
            for topic, payload in self.latest.items()
            if topic.endswith("/availability") and payload == {"v": 1, "state": "online"}
        }

    def said(self, device: str, *parts: str) -> dict[str, Any] | None:
        """Return the event of `device` whose text holds all `parts`."""
        for event in self.events:
            if event["id"] == device and all(part in event["text"] for part in parts):
                return event
        return None

    def texts(self) -> str:
        """Return all events, for messages of tests."""
        return "\n".join(f"{e['level']} {e['kind']} {e['id']}: {e['text']}" for e in self.events)

    async def until(self, condition: Callable[[], object], within_s: float = 10.0) -> None:
        """Wait for a condition; what was said is in the failure."""
        try:
            async with asyncio.timeout(within_s):
                while not condition():
                    await asyncio.sleep(0.01)
        except TimeoutError:
            raise AssertionError(
                f"not within {within_s:g} s; online: {sorted(self.online)}\n{self.texts()}"
            ) from None

    async def connected(self, devices: set[str], within_s: float = 15.0) -> None:
        """Wait until exactly these are among the available."""
        await self.until(lambda: devices <= self.online, within_s)

    async def more_poses(self, count: int = 20, within_s: float = 10.0) -> list[dict[str, Any]]:
        """Wait for `count` poses from now on and return just these; more may have come at once."""
        before = len(self.poses)
        await self.until(lambda: len(self.poses) >= before + count, within_s)
        return self.poses[before : before + count]

    async def health(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait for a health message from now on that meets `condition`."""
        before = self.healths
        await self.until(
            lambda: self.healths > before and condition(self.latest["bridge/health"]["devices"])
        )
        devices: dict[str, Any] = self.latest["bridge/health"]["devices"]
        return devices

    async def phase(self, name: str, seconds: float, *, force: bool = False) -> Any:
        """Run one phase of a calibration; return the status that ended it."""
        assert self.client is not None
        self.calibration.begin()
        asked = {"phase": name, "seconds": seconds, "force": force}
        answer = await self.client.request("calibrate", asked)
        assert answer["status"] == "accepted", answer
        async with asyncio.timeout(seconds + 30):
            return await self.calibration.wait_for_end(name)


def sensors_in(pose: dict[str, Any]) -> set[str]:
    """Return which sensors a pose was made from."""
    return {sensor for part in pose["segments"].values() for sensor in part["used"]}


def knee_angles(poses: list[dict[str, Any]]) -> list[float]:
    """Return the knee's inner angle of each pose that has one, deg."""
    found = [pose["joints"]["knee"]["inner_deg"] for pose in poses]
    return [angle for angle in found if angle is not None and math.isfinite(angle)]


@contextlib.asynccontextmanager
async def listening(port: int, base: str = BASE) -> AsyncIterator[Listener]:
    """Yield somebody who listens to everything."""
    listener = Listener(broker(port, base))
    task = asyncio.create_task(listener.run(), name="listener")
    try:
        yield listener
    finally:
        task.cancel()
        await asyncio.wait([task])


@dataclass
class Station:
    """A simulator and a daemon on its rig."""

    folder: Path
    port: int
    options: tuple[str, ...] = ()
    more_toml: str = ""
    """Appended to the rig.toml that the simulator wrote."""

    @property
    def rig(self) -> Path:
        """The daemon's rig.toml."""
        return self.folder / "daemon.toml"

    @property
    def log(self) -> str:
        """What the daemon wrote to its log."""
        return (self.folder / "daemon.log").read_text("utf-8", "replace")

    def write_rig(self, *changes: tuple[str, str]) -> None:
        """Write the simulator's rig for the daemon, each (old, new) replaced once."""
        text = (self.folder / "rig.toml").read_text(encoding="utf-8") + self.more_toml
        text = text.replace("[mqtt]\n", "[mqtt]\nhealth_s = 0.5\n")
        for old, new in changes:
            assert text.count(old) == 1, (old, text)
            text = text.replace(old, new)
        self.rig.write_text(text, encoding="utf-8")
        load_rig(self.rig)

    @contextlib.asynccontextmanager
    async def simulator(self, *changes: tuple[str, str]) -> AsyncIterator[Simulator]:
        """Yield virtual hardware that is ready; the rig is written."""
        async with simulator_child(self.folder, self.port, BASE, self.options) as child:
            await child.ready()
            self.write_rig(*changes)
            yield child

    @contextlib.asynccontextmanager
    async def daemon(self) -> AsyncIterator[ChildProcess]:
        """Yield the daemon's process."""
        async with daemon_child(self.folder, self.rig) as child:
            yield child


@contextlib.asynccontextmanager
async def in_this_process(scene: Scene) -> AsyncIterator[None]:
    """Run virtual hardware here, where a test can reach into it; raise what it raised."""
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
    station: Station, within_s: float = 15.0
) -> AsyncIterator[tuple[Simulator, ChildProcess, Listener]]:
    """Yield simulator, daemon and listener, all sources online."""
    async with (
        station.simulator() as simulator,
        station.daemon() as daemon,
        listening(station.port) as listener,
    ):
        wanted = {source.id for source in load_rig(station.rig).sources}
        await listener.connected(wanted, within_s)
        yield simulator, daemon, listener


async def stopped(
    daemon: ChildProcess, number: signal.Signals = signal.SIGTERM
) -> tuple[int, float]:
    """Send a signal; return the exit code and how long it took, s."""
    assert daemon.process is not None
    began = time.monotonic()
    daemon.process.send_signal(number)
    async with asyncio.timeout(20):
        code = await daemon.process.wait()
    return code, time.monotonic() - began


def restore_signals() -> None:
    """Let a child process be stopped, whoever started the tests: nohup and `&` ignore signals."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def hang_up(daemon: ChildProcess) -> None:
    """Ask for a reload."""
    assert daemon.process is not None
    daemon.process.send_signal(signal.SIGHUP)


def unbalanced(devices: dict[str, Any]) -> dict[str, dict[str, int]]:
    """Return the devices whose samples do not add up, or wait for a verdict still."""
    return {
        name: {key: device[key] for key in ("received", *VERDICTS, "pending")}
        for name, device in devices.items()
        if device["received"] != sum(device[key] for key in VERDICTS) or device["pending"]
    }


def store_calibration(rig_file: Path, state: Path) -> None:
    """Store a static calibration of sensors whose axes are those of their segments."""
    rig = load_rig(rig_file)
    t_ns = np.arange(400, dtype=np.int64) * 10_000_000
    still = np.tile((1.0, 0.0, 0.0, 0.0), (len(t_ns), 1))
    names = [name for group in rig.chain.sensors for name in group]
    trial = CalibrationTrial({name: SensorTrack(t_ns, still) for name in names}, None)
    pose = fit_static(trial, rig.calibration, rig.chain)
    CalibrationStore(state / "calibrations", rig.calibration_store).save(
        fit_static_only(pose, None, rig.chain)
    )
