"""One run of the demo, which connects, calibrates, and evaluates live joint angles.

The run observes the daemon over MQTT only. The ground truth is in the simulator's log.
"""

from __future__ import annotations

import asyncio
import gc
import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.tools.calibrate import PhaseTracker, raise_if_refused
from jointfit_daemon.tools.child_processes import time_limit
from jointfit_daemon.tools.demo._score import DemoScore, RmsAccumulator, percentile

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.tools.child_processes import ChildProcess, Simulator
    from jointfit_daemon.tools.demo._display import DemoDisplay
    from jointfit_daemon.tools.demo._truth import TruthReader

TOPICS = ("pose", "calibration", "calibration/progress", "bridge/health", "device/+/availability")
CONNECT_S, FINISH_S = 30.0, 15.0
"""Time limits, s: to connect all sources, and to count the last samples."""
SETTLE_S = 3.0
"""Time for the device clocks to converge and for a new motion to begin, s."""


class DemoLimb(NamedTuple):
    """Movements of the simulated subject for one limb, and the joint compared with ground truth."""

    joint: str
    functional: tuple[tuple[str, float], ...]
    """Motions of the functional phase and their durations, s."""
    live: tuple[str, ...]
    """Motions of the live phase; each motion lasts `MOTION_S`."""


LIMBS = {
    "leg": DemoLimb(
        "knee",
        (("functional", 20.0), ("walk", 9.0), ("squat", 9.0), ("sit_to_stand", 9.0)),
        ("walk", "squat", "sit_to_stand"),
    ),
    "legs": DemoLimb(
        "right_knee",
        (("functional", 32.0), ("walk", 10.0), ("squat", 9.0), ("sit_to_stand", 9.0)),
        ("walk", "squat", "sit_to_stand"),
    ),
    "arm": DemoLimb(
        "elbow",
        (("functional", 20.0), ("elbow_flexion", 9.0), ("wrist_circles", 9.0), ("reach", 9.0)),
        ("reach", "elbow_flexion", "abduction"),
    ),
    "trunk": DemoLimb(
        "lumbar",
        (("functional", 20.0), ("bend", 9.0), ("twist", 9.0), ("side_bend", 9.0)),
        ("bend", "twist", "side_bend"),
    ),
}
"""Limbs of the demo."""
MOTION_S = 8.0
"""Duration of each motion in the live phase, s."""
TRUTH_S = 0.1
"""Time between two readings of the ground-truth file, s."""
MATURE_NS = 300_000_000
"""Age at which a pose is evaluated, ns. At this age, its ground truth is in the file."""
CALIBRATIONS = "state/calibrations"
"""Calibration store of the demo, relative to its folder."""
OUTCOMES = ("used", "decimated", "idle", "late", "duplicate", "dropped")


@dataclass(slots=True)
class DemoRun:
    """State and results of one demo run."""

    folder: Path
    rig: Rig
    simulator: Simulator
    daemon: ChildProcess
    truth: TruthReader
    display: DemoDisplay
    limb: DemoLimb = LIMBS["leg"]
    score: DemoScore = field(default_factory=DemoScore)
    latencies_ms: list[float] = field(default_factory=list)
    online: set[str] = field(default_factory=set)
    _health: dict[str, Any] = field(default_factory=dict)
    _healths: int = 0
    _poses: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    _evaluating: bool = False
    _static_ns: int = 0
    _sent: dict[str, Any] | None = None
    _tracker: PhaseTracker | None = None

    async def run(self, seconds: float) -> None:
        """Run all steps; `figures` then returns the results, even after an interruption."""
        async with MqttClient(self.rig.mqtt) as client:
            await client.subscribe(*TOPICS)

            # A pause of this process would count as latency of the daemon. Garbage collection
            # therefore excludes the imported objects, and the ground truth is read in short
            # intervals.
            gc.freeze()
            tasks = [
                asyncio.create_task(self._listen(client), name="demo listener"),
                asyncio.create_task(self._read_truth(), name="demo ground truth"),
            ]
            try:
                await self._connect()
                await self._calibrate(client)
                await self._live(seconds)
                self._sent = await self._finish()
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)

    # --- messages of the daemon --------------------------------------------------------------

    async def _listen(self, client: MqttClient) -> None:
        async for topic, payload in client.messages():
            now_us = time.time_ns() // 1000
            if not isinstance(payload, dict):
                continue
            if topic == "pose":
                self._pose(payload, now_us)
            elif topic == "bridge/health":
                self._health, self._healths = payload, self._healths + 1
            elif topic == "calibration" and self._tracker is not None:
                self._tracker.on_status(payload)
            elif topic == "calibration/progress" and self._tracker is not None:
                self._tracker.on_progress(payload)
            elif topic.endswith("/availability"):
                device = topic.split("/")[1]
                online = payload.get("state") == "online"
                (self.online.add if online else self.online.discard)(device)

    def _pose(self, pose: dict[str, Any], now_us: int) -> None:
        if not self._evaluating:
            return
        self.latencies_ms.append((now_us - pose["completed_us"]) / 1e3)
        unix_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
        self._poses.append((pose["t_us"] * 1000 - unix_minus_monotonic_ns, pose))

    async def _read_truth(self) -> None:
        while True:
            self.truth.read()
            await asyncio.sleep(TRUTH_S)

    def _evaluate(self) -> None:
        """Compare each pose with the ground truth as soon as this truth is available."""
        mature = time.monotonic_ns() - MATURE_NS
        while self._poses and self._poses[0][0] < mature:
            t_ns, pose = self._poses.pop(0)
            if (truth := self.truth.track.at(t_ns)) is not None:
                self.score.add(pose, truth, self.limb.joint)
                rms, p50 = self.score.flexion.rms, percentile(self.latencies_ms[-500:], 0.5)
                shown = {
                    "frames": self.score.frames,
                    "flexion RMSE": "—" if rms is None else f"{rms:.2f}°",
                    "latency": "—" if p50 is None else f"{p50:.1f} ms",
                }
                self.display.live(pose, truth, shown)

    # --- steps -------------------------------------------------------------------------------

    async def _connect(self) -> None:
        wanted = {source.id for source in self.rig.sources}
        async with time_limit(CONNECT_S, "connecting all sources"):
            while not wanted <= self.online:
                self.daemon.check()
                self.simulator.check()
                share = len(self.online & wanted) / len(wanted)
                self.display.step("connect", share, f"{len(self.online)} of {len(wanted)} sources")
                await asyncio.sleep(0.1)
        await asyncio.sleep(SETTLE_S)  # wait until the device clocks have converged

    async def _calibrate(self, client: MqttClient) -> None:
        self._tracker = PhaseTracker(self.display.step, self.display.figures)
        phases = (
            ("align", (("plate", 20.0),)),
            ("static", (("stand", 5.0),)),
            ("functional", self.limb.functional),
        )
        for phase, motions in phases:
            await self.simulator.send_command(f"play {motions[0][0]}")
            await asyncio.sleep(SETTLE_S)
            self._tracker.begin()
            wanted_s = sum(seconds for _, seconds in motions)
            wanted = {"phase": phase, "seconds": wanted_s}
            raise_if_refused(await client.request("calibrate", wanted))
            self.display.step(phase, 0.0, "")

            async def move(motions: tuple[tuple[str, float], ...] = motions) -> None:
                for name, seconds in motions:
                    await self.simulator.send_command(f"play {name}")
                    await asyncio.sleep(seconds)

            moving = asyncio.create_task(move(), name="demo wearer")
            try:
                await self._tracker.wait_for_end(phase)
            finally:
                moving.cancel()
                await asyncio.wait([moving])
            if phase == "static":
                self._static_ns = time.monotonic_ns() - 1_000_000_000

    async def _live(self, seconds: float) -> None:
        self._evaluating = True
        began = time.monotonic()
        played = -1
        while (elapsed := time.monotonic() - began) < seconds:
            self.daemon.check()
            if int(elapsed / MOTION_S) > played:
                played = int(elapsed / MOTION_S)
                motions = self.limb.live
                await self.simulator.send_command(f"play {motions[played % len(motions)]}")
            self.display.step("live", elapsed / seconds, f"{seconds - elapsed:.0f} s to go")
            await asyncio.sleep(0.1)
            self._evaluate()

    async def _finish(self) -> dict[str, Any]:
        """Stop the simulator, then wait until all samples in transit are counted."""
        self._evaluate()
        self._evaluating = False

        totals = await self.simulator.quit()
        wanted = {source.id for source in self.rig.sources}
        before = self._healths
        async with time_limit(FINISH_S, "counting the last samples"):
            while self.online & wanted or self._healths < before + 2:  # noqa: ASYNC110 - two facts
                await asyncio.sleep(0.1)

        sent: dict[str, Any] = totals["sent"]
        return sent

    # --- results -----------------------------------------------------------------------------

    def figures(self) -> dict[str, Any]:
        """Return errors, latency and sample counts; None for values not yet known.

        Samples that have no outcome yet count as dropped.
        """
        devices = self._health.get("devices", {})
        counts = {
            key: sum(int(device.get(key) or 0) for device in devices.values())
            for key in ("received", *OUTCOMES, "pending")
        }
        counts["dropped"] += counts.pop("pending")

        # An unaccounted sample has no outcome, or was sent but not received.
        sent, unaccounted = self._sent or {}, dict[str, int]()
        for name, device in devices.items():
            received = int(device.get("received") or 0)
            outcomes = sum(int(device.get(key) or 0) for key in (*OUTCOMES, "pending"))
            lost = abs(received - outcomes) + abs(int(sent.get(name, 0)) - received)
            if lost:
                unaccounted[name] = lost

        return {
            "frames": self.score.frames,
            f"{self.limb.joint}_flexion_rmse_deg": _round_figure(self.score.flexion.rms),
            **{
                f"{name}_rmse_deg": _round_figure(error.rms)
                for name, error in self.score.segments.items()
                if name in self.rig.chain.segments
            },
            "joint_center_error_mm": _round_figure(self._center_error_mm()),
            "latency_ms": {
                "p50": _round_figure(percentile(self.latencies_ms, 0.5)),
                "p99": _round_figure(percentile(self.latencies_ms, 0.99)),
            },
            "samples": counts,
            "corrupt": sum(int(device.get("corrupt") or 0) for device in devices.values()),
            "sent": None if self._sent is None else sum(sent.values()),
            "unaccounted": None if self._sent is None else sum(unaccounted.values()),
            "unaccounted_by_source": None if self._sent is None else unaccounted,
            "within_2_sd_share": _round_figure(self.score.covered / max(1, self.score.flexion.n)),
        }

    def _center_error_mm(self) -> float | None:
        """Return the RMS error of the fitted joint centres in the static pose, mm, or None."""
        stored = CalibrationStore(self.folder / CALIBRATIONS, self.rig.calibration_store).latest()
        truth = self.truth.track.at(self._static_ns)
        if stored is None or truth is None:
            return None
        error = RmsAccumulator()
        for name, joint in stored.calibration.joint.items():
            if joint.center is not None and joint.source == "fit" and name in truth.centers:
                error.add(1e3 * math.dist(joint.center, truth.centers[name]))
        return error.rms


def _round_figure(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
