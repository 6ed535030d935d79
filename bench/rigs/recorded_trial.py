"""Replays a recorded trial as bytes through the daemon, and evaluates the MQTT messages.

Invariant: three processes exchange only bytes: `jointfit-sim play --trial`, the daemon, and a
broker. The `pose` messages are compared with the simulator's ground truth at the times of the
poses, and with the limb states of an offline run of the same session. The daemon is calibrated on a
static pose and the first 60 % of the squats. The last 40 % are evaluated. The regressions of the
patent run in the procedure of the patent: they receive the whole trial, fit the first 60 %, and
verify on the rest.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import tempfile
import time
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from bench.rigs.offline_session import calibrate, fuse_session
from bench.subjects.recorded_knee import FOLDER, Judge, KneeTrial, load, training_frames
from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import MqttSettings
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import PatentReading
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.tools.child_processes import daemon, simulator
from tests.broker_fixture import chosen_broker

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Calibration, Method, Procedure
    from jointfit_daemon.model import LimbState
    from jointfit_daemon.tools.child_processes import Simulator

SOURCES = {"S1", "S2", "S3", "S4", "mocap"}
SETTLE_S, STATIC_S = 3.0, 3.5
BLEND_S = 1.0
"""Duration of the interpolation from standing to the first frame of the trial, s. The cameras track
no bodies during the interpolation."""
POLL_S = 0.05
SPARE_S = 1.0
"""Time by which a phase is longer than its motion, s. Late bytes arrive in this time, and the
cameras track no bodies."""
SQUATS_HZ, WALKING_HZ = 50.0, 100.0
SEGMENTS = ("thigh", "shank")
FRAME_NS, MATCH_NS = 10_000_000, 1_000_000
"""Interval between frames, ns, and tolerance of their times, ns. Truth and poses have times at
multiples of 10 ms of the same clock, apart from rounding."""
PLAYS, IN_TIME = 3, 0.9
"""Maximum number of plays of a trial, and smallest share of frames without late samples with which
a play is not repeated."""
FADE_NS = 250_000_000
"""Time for which the output fades after a sensor was missing, ns."""
CONNECT_S, PATIENCE_S = 80.0, 300.0
REGRESSIONS: tuple[str, ...] = get_args(PatentReading)
"""Methods that run in the procedure of the patent."""
ENDS = {"static": "posed", "functional": "calibrated"}
"""State that ends each phase successfully."""


class MachineTooSlowError(Exception):
    """Late samples, which this machine delayed, affected every frame of a play."""


@dataclass(slots=True)
class Gateway:
    """Simulated scene, daemon, and the messages of the daemon."""

    folder: Path
    sim: Simulator
    client: MqttClient
    poses: list[dict[str, Any]] = field(default_factory=list)
    online: set[str] = field(default_factory=set)
    health: dict[str, Any] = field(default_factory=dict)
    sensors: dict[int, dict[str, Any]] = field(default_factory=dict)
    """Sensors in the message `sensors/pose`, by frame number."""
    regression: dict[str, Any] = field(default_factory=dict)
    """Coefficients in the message `calibration`, by segment; empty if the method is not a
    regression."""
    _phases: asyncio.Queue[dict[str, Any]] = field(default_factory=asyncio.Queue)

    async def listen(self) -> None:
        async for topic, payload in self.client.messages():
            if topic == "pose":
                self.poses.append(payload)
            elif topic == "sensors/pose":
                self.sensors[payload["seq"]] = payload["sensors"]
            elif topic == "calibration":
                self._phases.put_nowait(payload)
                self.regression = payload["quality"].get("regression") or {}
            elif topic == "bridge/health":
                self.health = payload
            elif topic.endswith("/availability"):
                online = payload == {"v": 1, "state": "online"}
                (self.online.add if online else self.online.discard)(topic.split("/")[1])

    async def connected(self, settle_s: float = SETTLE_S) -> None:
        async with asyncio.timeout(CONNECT_S):
            while not self.online >= SOURCES:  # noqa: ASYNC110 - five sources
                await asyncio.sleep(0.05)
        await asyncio.sleep(settle_s)

    async def phase(self, name: str, seconds: float) -> None:
        """Run one phase of a calibration to its end."""
        while not self._phases.empty():  # earlier messages do not belong to this phase
            self._phases.get_nowait()
        answer = await self.client.request("calibrate", {"phase": name, "seconds": seconds})
        if answer["status"] != "accepted":
            raise RuntimeError(f"{name}: {answer}")
        async with asyncio.timeout(seconds + PATIENCE_S):
            while (status := await self._phases.get())["phase"] != ENDS[name]:
                if status["phase"] == "aborted":
                    raise RuntimeError(f"{name}: {status['text']}")

    async def play(self, motion: str) -> None:
        """Start a motion; return during its interpolation, when the cameras track no bodies."""
        await self.sim.send_command(f"play {motion}")
        async with asyncio.timeout(PATIENCE_S):
            while True:
                await self.sim.send_command("status")
                if (await self.sim.answer()).get("motion") == motion:
                    return
                await asyncio.sleep(POLL_S)

    async def live(self, motion: str, seconds: float) -> None:
        """Play a motion for `seconds`."""
        await self.play(motion)
        await asyncio.sleep(BLEND_S + seconds + SPARE_S)

    def calibration(self) -> Calibration:
        """Return the calibration that the daemon has stored."""
        stored = CalibrationStore(self.folder / "state" / "calibrations", "demo").latest()
        if stored is None:
            raise RuntimeError("no calibration was stored")
        return stored.calibration


@asynccontextmanager
async def gateway(folder: Path, port: int, options: Sequence[str]) -> AsyncIterator[Gateway]:
    """Start simulator and daemon; stop both at the end."""
    base = f"jointfit/{folder.name}"
    settings = MqttSettings(host="127.0.0.1", port=port, base=base)
    async with (
        simulator(folder, port, base, options) as sim,
        MqttClient(settings) as client,
    ):
        ready = await sim.ready()
        await client.subscribe(
            "pose", "sensors/pose", "calibration", "bridge/health", "device/+/availability"
        )
        found = Gateway(folder, sim, client)
        listening = asyncio.create_task(found.listen(), name="listener")
        try:
            async with daemon(folder, Path(ready["rig"])):
                yield found
                await sim.quit()
        finally:
            listening.cancel()
            await asyncio.wait([listening])


# --- trials ------------------------------------------------------------------------------------


def _options(files: Sequence[Path], rate_hz: float, method: Method) -> list[str]:
    """Return the options of a scene without errors other than the recorded errors."""
    knobs = {
        "mocap_hz": rate_hz,
        "transition_s": BLEND_S,
        "clock_offset_s": 0,
        "latency_uart_ms": 0,
        "latency_can_ms": 0,
        "latency_mocap_ms": 0,
    }
    return [
        *("--trial", *map(str, files), "--perfect", "--rate", f"{rate_hz:g}"),
        *(word for name, value in knobs.items() for word in ("--set", f"{name}={value:g}")),
        *("--output-rate-hz", f"{rate_hz:g}", "--method", method, "--axes", "static"),
        *("--static-s", f"{STATIC_S:g}", "--sensors-hz", f"{rate_hz:g}"),
        *("--procedure", _procedure(method)),
    ]


async def squats(data: Path, folder: Path, port: int, method: Method) -> Played:
    """Calibrate on the first 60 % of the squats, and evaluate the rest live.

    For the regressions of the patent, the daemon itself holds out the last 40 % of the trial.
    """
    files = _files(data, "squats1")
    whole = load(data, "squats1")
    cut, last = training_frames(whole), len(whole) - 1
    end = last if method in REGRESSIONS else cut - 1
    shutil.rmtree(folder / "state", ignore_errors=True)  # remains of an earlier play
    async with gateway(folder, port, _options(files, SQUATS_HZ, method)) as running:
        await running.connected()
        await running.phase("static", STATIC_S)
        await running.play(f"trial@0-{end / SQUATS_HZ:g}")
        await running.phase("functional", BLEND_S + end / SQUATS_HZ + SPARE_S)
        await running.live(f"trial@{cut / SQUATS_HZ:g}-", (last - cut) / SQUATS_HZ)
    return _judged(running, data, files, method)


async def walking(data: Path, folder: Path, port: int, method: Method) -> Played:
    """Restart with the squat calibration in `folder`, and evaluate walking live."""
    files = _files(data, "walking1")
    async with gateway(folder, port, _options(files, WALKING_HZ, method)) as running:
        await running.connected(2 * SETTLE_S)  # 1 ms of time error causes 0.5° of angle error
        await running.live("trial", 1.3)
    return _judged(running, data, files, method)


def _files(data: Path, trial: str) -> list[Path]:
    return [data / FOLDER / name for name in (f"{trial}.npz", "static_bias.json")]


def _procedure(method: Method) -> Procedure:
    return "patent" if method in REGRESSIONS else "corrected"


# --- evaluation --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Played:
    """Results of one live part."""

    frames: int
    """Number of evaluated poses."""
    recorded: int
    """Number of frames of the offline run that use all sensors."""
    errors: tuple[float, float, float]
    """RMS errors of thigh, shank and knee flexion, deg."""
    offline: tuple[float, float, float]
    """RMS errors of the offline run at the same times, deg."""
    calibration: Calibration
    health: dict[str, Any]
    """Devices in the daemon's last health message."""
    repeated_deg: float | None
    """Largest angle between a segment in `pose` and the regression of the patent, deg. The
    regression is evaluated from the messages `sensors/pose` and `calibration`. None without a
    regression."""


def _judged(running: Gateway, data: Path, files: Sequence[Path], method: Method) -> Played:
    """Evaluate the poses and the offline run at the times of the recorded truth."""
    log = running.folder / "truth.jsonl"
    truth, poses = _recorded_truth(log), _calibrated_poses(running.poses)
    whole = load(data, "squats1")
    training = training_frames(whole)

    # Times of the daemon's frames for the offline run, including frames without a received message.
    instants = sorted(poses)
    period_ns = min(b - a for a, b in pairwise(instants))
    grid = range(instants[0], instants[-1] + 1, period_ns)
    fit = calibrate(_files(data, "squats1"), training, method, _procedure(method))
    offline = fuse_session(files, log, grid, fit, BLEND_S)

    # Frames with all sensors, both live and offline.
    complete = [t for t in grid if t in truth and _is_complete(*_used(offline[t]))]
    late = {t for t in poses if _used_live(poses[t])[1] < _used(offline[t])[1]}
    chosen = [
        t
        for t in complete
        if t in poses
        and _is_complete(*_used_live(poses[t]))
        and not any(t - FADE_NS <= missed <= t for missed in late)
    ]
    if not chosen:
        raise MachineTooSlowError(f"{method}: no frame of {files[0].name} with all sensors in time")
    calibration = running.calibration()
    femur, tibia = (np.array([truth[t][i] for t in chosen]) for i in range(2))
    judge = Judge.of(whole.part(slice(0, training)))
    bones = KneeTrial((femur,) * 4, femur, tibia)
    # The rotation from bone frames to calibration frames is constant and is removed here.
    live = _in_bone_frames(
        [[poses[t]["segments"][name]["q"] for t in chosen] for name in SEGMENTS], calibration
    )
    expected = _in_bone_frames(
        [[offline[t].segments[i].q_world_segment for t in chosen] for i in range(2)], fit
    )
    return Played(
        len(chosen),
        len(complete),
        judge.errors(live, bones),
        judge.errors(expected, bones),
        calibration,
        running.health,
        _repeated_deg(running),
    )


def _calibrated_poses(poses: Iterable[Mapping[str, Any]]) -> dict[int, Mapping[str, Any]]:
    """Return the poses since the calibration, by host time in ns."""
    unix_ns = time.time_ns() - time.monotonic_ns()
    found = {}
    for pose in poses:
        t_ns = pose["t_us"] * 1000 - unix_ns
        at = round(t_ns / FRAME_NS) * FRAME_NS
        if "uncalibrated" not in pose["flags"] and abs(at - t_ns) < MATCH_NS:
            found[at] = pose
    return found


def _used(state: LimbState) -> tuple[Sequence[str], int]:
    """Return flags and the number of sensors used."""
    return state.flags, sum(len(segment.used) for segment in state.segments)


def _used_live(pose: Mapping[str, Any]) -> tuple[Sequence[str], int]:
    return pose["flags"], sum(len(pose["segments"][name]["used"]) for name in SEGMENTS)


def _is_complete(flags: Sequence[str], sensors: int) -> bool:
    """Return whether all sensors have a measurement in a frame, without extrapolation."""
    return "extrapolating" not in flags and sensors == len(SOURCES) - 1


def _in_bone_frames(
    segments: Sequence[Sequence[Any]], calibration: Calibration
) -> tuple[Array, Array]:
    thigh, shank = (
        rotation.multiply(
            np.array(q), rotation.conjugate(np.array(calibration.segment[name].q_static))
        )
        for q, name in zip(segments, SEGMENTS, strict=True)
    )
    return thigh, shank


def _repeated_deg(running: Gateway) -> float | None:
    """Compute the patent's fusion (step S4) from the messages alone, see `Played.repeated_deg`."""
    largest = None
    for pose in running.poses:
        sensors = running.sensors.get(pose["seq"], {})
        for segment, fit in running.regression.items():
            said = pose["segments"][segment]["q"]
            inputs = [sensors.get(name, {}).get("q_segment") for name in fit["sensors"]]
            if said is None or None in inputs:
                continue
            table = np.array(fit["stored"])
            y = table[:, -1].copy()
            for k, q in enumerate(np.array(inputs)):
                y += table[:, k] * (q if q @ fit["q_sign"] >= 0.0 else -q)
            apart = float(np.degrees(rotation.angle_between(rotation.normalize(y), said)))
            largest = apart if largest is None else max(largest, apart)
    return largest


def _recorded_truth(path: Path) -> dict[int, list[list[float]]]:
    """Return the orientations of thigh and shank by time, ns.

    Times during the interpolation between motions have no joint positions and are omitted.
    """
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines()[1:]:
        row = json.loads(line)
        if row["motion"] != "stand" and row["joint_m"]["knee"][0] is not None:
            found[row["t_ns"]] = [row["q_world_segment"][name] for name in SEGMENTS]
    return found


# --- complete runs -----------------------------------------------------------------------------


async def _undelayed(
    play: Callable[[Path, Path, int, Method], Awaitable[Played]],
    data: Path,
    folder: Path,
    port: int,
    method: Method,
) -> Played:
    """Return the play with the largest share of frames without late samples.

    The trial is played at most `PLAYS` times. If the share reaches `IN_TIME`, no further play
    follows.
    """
    best: Played | None = None
    for _ in range(PLAYS):
        with suppress(MachineTooSlowError):
            played = await play(data, folder, port, method)
            if best is None or played.frames * best.recorded > best.frames * played.recorded:
                best = played
            if played.frames >= IN_TIME * played.recorded:
                break
    if best is None:
        raise MachineTooSlowError(f"{method}: no frame with all sensors in time; stop other loads")
    return best


async def _everything(
    data: Path, folder: Path, methods: Sequence[Method], walkers: Sequence[Method]
) -> dict[tuple[str, Method], Played]:
    broker = chosen_broker()(folder)
    broker.start()
    found: dict[tuple[str, Method], Played] = {}
    try:
        for method in methods:
            home = folder / method
            home.mkdir()
            for name, play in (("squats", squats), ("walking", walking)):
                if name == "squats" or method in walkers:
                    found[name, method] = await _undelayed(play, data, home, broker.port, method)
    finally:
        broker.stop()
    return found


def run(
    data: Path, methods: Sequence[Method], walkers: Sequence[Method] = ()
) -> dict[tuple[str, Method], Played]:
    """Play the squats with one method after another, and walking with the methods in `walkers`.

    A method needs about 35 s, and 10 s more for walking, because trials run in real time. Parallel
    runs would delay each other, and late samples would enter the training.
    """
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(_everything(data, Path(folder), methods, walkers))
