"""CPU time of the core with settings for weak gateways: lower rates, and no cameras.

Each setting has its own rig and core. The settings are measured in turn, so a busy machine slows
all of them equally. In each turn, a core processes one second of data of four sensors, and every
pose is encoded.
"""

from __future__ import annotations

import gc
import statistics
import time
from dataclasses import dataclass, replace
from heapq import merge
from typing import TYPE_CHECKING

from bench.experiments.speed.core import START_NS, events, worn
from bench.framework.measurement import speed_experiment, timed_result
from bench.subjects.device_bytes import natnet_datagrams, natnet_opening
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.model import Chunk, LimbState
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from bench.framework.experiment import Result
    from jointfit_daemon.model import Vector
    from jointfit_daemon.pipeline.events import Event

SETTLE_S, ROUNDS, QUICK_ROUNDS = 3, 9, 2
CAMERA_NS = 10_000_000
UNIX_NS = 1_700_000_000 * NS_PER_S


@dataclass(frozen=True)
class Setting:
    """Rates of one rig."""

    sensors_hz: float = 200.0
    poses_hz: float = 100.0
    cameras: bool = True

    @property
    def name(self) -> str:
        """Name of the setting in the table."""
        cameras = "cameras of 100 Hz" if self.cameras else "no cameras"
        return f"4 × {self.sensors_hz:g} Hz, {cameras}, {self.poses_hz:g} poses/s"


SETTINGS = (
    Setting(),
    Setting(cameras=False),
    Setting(poses_hz=50.0, cameras=False),
    Setting(poses_hz=20.0, cameras=False),
    Setting(sensors_hz=100.0, cameras=False),
    Setting(sensors_hz=100.0, poses_hz=50.0, cameras=False),
    Setting(sensors_hz=50.0, poses_hz=50.0, cameras=False),
    Setting(sensors_hz=50.0, poses_hz=20.0, cameras=False),
)


class _Gateway:
    """A core with one setting, and its events for each second."""

    def __init__(self, setting: Setting, seconds: int) -> None:
        self._setting = setting
        stream = list(events(setting.sensors_hz, float(seconds)))
        if setting.cameras:
            stream = [*_opening(), *merge(stream, _camera_frames(seconds), key=_instant)]
        self._seconds: list[list[Event]] = [[] for _ in range(seconds + 1)]
        for event in stream:
            self._seconds[min(seconds, (_instant(event) - START_NS) // NS_PER_S)].append(event)

        rig = replace(bench_rig(setting.sensors_hz), output_rate_hz=setting.poses_hz)
        self._core = Core()
        self._core.feed(Configured(START_NS, rig, worn(), 1))
        self._next = 0

    def cpu_s(self) -> float:
        """Return the CPU time of the next second of data, s."""
        batch, core, poses = self._seconds[self._next], self._core, 0
        self._next += 1
        began = time.thread_time()
        for event in batch:
            outputs = core.feed(event)
            _ = core.next_deadline_ns  # the runner reads the deadline after every event
            for output in outputs:
                if isinstance(output, LimbState):
                    encode_pose(output, UNIX_NS, output.completed_ns)
                    poses += 1
        spent = time.thread_time() - began
        if self._next > SETTLE_S:
            assert abs(poses - self._setting.poses_hz) <= 2, f"{self._setting.name}: {poses} poses"
        return spent


def _places() -> dict[str, Vector]:
    """Return the marker positions of the calibrated leg in the static pose, m."""
    return {
        name: (cluster.origin[0] + x, cluster.origin[1] + y, cluster.origin[2] + z)
        for cluster in worn().clusters.values()
        for name, (x, y, z) in zip(cluster.markers, cluster.template, strict=True)
    }


def _opening() -> list[Event]:
    data = [ChunkArrived("mocap", Chunk(START_NS, data)) for data in natnet_opening()]
    return [SourceOpened(START_NS, "mocap"), *data]


def _camera_frames(seconds: int) -> list[Event]:
    frames = natnet_datagrams(100 * seconds, CAMERA_NS, _places())
    return [
        ChunkArrived("mocap", Chunk(START_NS + k * CAMERA_NS, data))
        for k, data in enumerate(frames, 1)
    ]


def _instant(event: Event) -> int:
    return event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns


def rows(quick: bool) -> list[Result]:
    """Return the CPU time per second of data, and its ratio to the first setting, by setting."""
    rounds = QUICK_ROUNDS if quick else ROUNDS
    gateways = {setting: _Gateway(setting, SETTLE_S + rounds) for setting in SETTINGS}
    for gateway in gateways.values():
        for _ in range(SETTLE_S):
            gateway.cpu_s()

    times: dict[Setting, list[float]] = {setting: [] for setting in SETTINGS}
    gc.collect()
    for _ in range(rounds):
        for setting, gateway in gateways.items():
            times[setting].append(gateway.cpu_s())
    found = []
    for setting, took in times.items():
        ratios = [a / b for a, b in zip(took, times[SETTINGS[0]], strict=True)]
        share = f"{100.0 * statistics.median(ratios):.0f} % of the first"
        ms = round(1e3 * statistics.median(took), 1)
        found.append(timed_result(setting.name, ms, "ms/s", note=share))
    return found


EXPERIMENTS = (speed_experiment("weak-gateway", "Lower rates and no cameras", rows),)
