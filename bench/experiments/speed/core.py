"""Speed of the core: clock, aligner, fusion, complete frames, and the encoding of a frame."""

from __future__ import annotations

import gc
import statistics
import time
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import loop_s, per_item, percentile, speed_experiment, timed_result
from bench.subjects import device_bytes
from bench.subjects.simulated_wearer import bench_rig, fitted, walking
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.model import LimbState, TickClock
from jointfit_daemon.outputs.payloads import encode_pose
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened
from jointfit_daemon.timing.alignment import FrameAligner
from jointfit_daemon.timing.clock import DeviceClock
from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.xcdi import XcdiIds
from jointfit_simulators.body import SENSORS

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chunk, Quaternion
    from jointfit_daemon.pipeline.events import Event

START_NS = 1_000 * NS_PER_S
SETTLE_S = 3.0
"""Time in which the clocks converge, s. It is not part of the measurement."""


@cache
def worn() -> Calibration:
    return fitted(bench_rig())


def clock_rows(quick: bool) -> list[Result]:
    n, period_ns = 4000, 2_500_000
    ticks = TickClock(100_000, 2**32)
    arrivals = [START_NS + k * period_ns + (k * 7919 % 997) * 1000 for k in range(n)]

    def work() -> Callable[[], object]:
        clock = DeviceClock(period_ns)
        return lambda: [
            clock.feed_sample(25 * k, k, arrival_ns, ticks) for k, arrival_ns in enumerate(arrivals)
        ]

    return [per_item("clock: one sample", work, items=n, goal_us=5, quick=quick)]


def align_rows(quick: bool) -> list[Result]:
    """Align four streams at 400 Hz to frames at 100 Hz.

    The time is advanced after each sample, as in the core.
    """
    period_ns, seconds = 2_500_000, 2
    n = seconds * NS_PER_S // period_ns
    orientations = walking("S1", NS_PER_S / period_ns, seconds)

    def work() -> Callable[[], object]:
        aligner = FrameAligner(dict.fromkeys(SENSORS, period_ns), 10_000_000)
        deadlines: list[int | None] = []

        def run() -> None:
            for k, q in enumerate(orientations):
                for number, sensor in enumerate(SENSORS):
                    t_ns = START_NS + k * period_ns + number * 300_000
                    aligner.push(sensor, t_ns, t_ns + 2_000_000, q)
                    aligner.advance(t_ns + 2_000_000)
                    deadlines.append(aligner.next_deadline_ns)

        return run

    items = n * len(SENSORS)
    return [per_item("aligner: one sample", work, items=items, goal_us=15, quick=quick)]


def _inputs(seconds: float) -> list[dict[str, Quaternion]]:
    tracks = {sensor: walking(sensor, 100.0, seconds) for sensor in SENSORS}
    return [dict(zip(SENSORS, row, strict=True)) for row in zip(*tracks.values(), strict=True)]


def _plainly(frames: list[dict[str, Quaternion]]) -> Callable[[], object]:
    """Return a function that applies the correction for arrays to one frame at a time.

    The daemon uses another form of the correction, for scalars.
    """
    segments = list(worn().segment.values())
    pairs = (("S1", "S2"), ("S3", "S4"))
    models = [segments[i].models[f"{'+'.join(pairs[i])}|{'+'.join(pairs[1 - i])}"] for i in (0, 1)]
    arrays = [{name: np.array([q]) for name, q in frame.items()} for frame in frames]

    def work() -> object:
        return [
            models[i].predict([frame[s] for s in pairs[i]], frame[pairs[1 - i][0]])
            for frame in arrays
            for i in (0, 1)
        ]

    return work


def fusion_rows(quick: bool) -> list[Result]:
    rig, frames = bench_rig(), _inputs(3.0)

    def fuse() -> Callable[[], object]:
        fuser = LimbFuser(rig.chain, worn())
        return lambda: [fuser.fuse(k * 10_000_000, 0, k, f) for k, f in enumerate(frames)]

    fuser = LimbFuser(rig.chain, worn())
    states = [fuser.fuse(k * 10_000_000, 0, k, frame) for k, frame in enumerate(frames)]
    assert all(state.mode == "imu" and state.joints[1].angles for state in states)
    n = len(frames)
    return [
        per_item("fusion: one frame of 4 sensors", fuse, items=n, goal_us=100, quick=quick),
        per_item(
            "fusion: soft-tissue models of both segments, plain NumPy",
            lambda: _plainly(frames),
            items=n,
            goal_us=None,
            quick=quick,
        ),
        per_item(
            "output: pose as JSON",
            lambda: lambda: [encode_pose(state, NS_PER_S, 2 * NS_PER_S) for state in states],
            items=n,
            goal_us=20,
            quick=quick,
        ),
    ]


# --- complete frames ----------------------------------------------------------------------------


@cache
def events(rate_hz: float, seconds: float) -> list[Event]:
    """Return the chunks of four IMUs during a walk, one per sample, in order of arrival."""
    period_ns = round(NS_PER_S / rate_hz)
    chunks: list[tuple[Chunk, str]] = []
    for number, sensor in enumerate(SENSORS, 1):
        orientations = walking(sensor, rate_hz, seconds)
        start_ns = START_NS + number * period_ns // 5
        if number % 2:
            found = device_bytes.xbus_chunks(orientations, period_ns, start_ns)
        else:
            block = number << 8
            ids = XcdiIds(block + 5, block + 6, block + 33, status_word=None, error=None)
            found = device_bytes.xcdi_chunks(orientations, period_ns, ids, start_ns)
        chunks += [(chunk, sensor) for chunk in found]
    chunks.sort(key=lambda pair: pair[0].t_ns)
    opened = [SourceOpened(START_NS, sensor) for sensor in SENSORS]
    return [*opened, *(ChunkArrived(sensor, chunk) for chunk, sensor in chunks)]


def frame_times(rate_hz: float, seconds: float) -> list[float]:
    """Return the CPU time of each limb state, s: of all chunks since the previous limb state."""
    core = Core()
    core.feed(Configured(START_NS, bench_rig(rate_hz), worn(), 1))
    stream = events(rate_hz, SETTLE_S + seconds)
    times: list[float] = []
    spent = 0.0
    for event in stream:
        began = time.thread_time()
        outputs = core.feed(event)
        deadline = core.next_deadline_ns  # the runner reads the deadline after every event
        spent += time.thread_time() - began
        states = [o for o in outputs if isinstance(o, LimbState)]
        if states:
            assert deadline is not None
            assert states[-1].mode == "imu", states[-1]
            times.append(spent / len(states))
            spent = 0.0
    return times[round(SETTLE_S * 100) :]


def core_rows(quick: bool) -> list[Result]:
    rows = []
    for rate_hz, median_us, worst_us in ((100.0, 250, 3000), (400.0, 1500, 3000)):
        gc.collect()
        times = frame_times(rate_hz, 2.0 if quick else 20.0)
        name = f"core: 4 × {rate_hz:g} Hz, bytes to limb state"
        middle, loop = statistics.median(times), loop_s()
        rows += [
            _row(f"{name}, median", middle, median_us, loop),
            _row(f"{name}, p99", percentile(times, 0.99), worst_us, loop),
        ]
    return rows


def _row(name: str, took_s: float, goal_us: float, loop: float) -> Result:
    return timed_result(
        name, round(took_s * 1e6, 1), "µs", goal_us, 4 * goal_us, ratio=round(took_s / loop, 3)
    )


EXPERIMENTS = (
    speed_experiment(
        "clock-time",
        "Device time to host time",
        clock_rows,
    ),
    speed_experiment(
        "frame-alignment-time",
        "Samples to frames",
        align_rows,
    ),
    speed_experiment(
        "fusion-frame-time",
        "Aligned frame to limb state and JSON",
        fusion_rows,
    ),
    speed_experiment(
        "core-step-time",
        "Bytes of four IMUs to limb states",
        core_rows,
    ),
)
