"""Growth of the core's CPU time and memory with sensors, segments, markers and run time.

A size is one number of sensors, segments or markers. Each rig receives all chunks of a frame, then
the chunks of the next frame. The sizes are measured in turn, so a busy machine slows all of them
equally. The cost of a size is the median over the rounds of the mean CPU time of a frame.
"""

from __future__ import annotations

import gc
import itertools
import statistics
import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.speed.instruction_counts import count_instructions
from bench.experiments.timing.memory import held
from bench.framework.experiment import Result
from bench.framework.exponents import growth_exponent, log_slope
from bench.framework.measurement import loop_s, speed_experiment, timed_result
from bench.subjects.growing_rigs import BEGIN_NS, GrowingRig
from jointfit_daemon.model import LimbState
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import Configured, SourceOpened

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.pipeline.events import ChunkArrived

SENSORS = (1, 2, 4, 8, 16, 32)
SEGMENTS = (1, 2, 4, 8, 16)
MARKERS = (3, 10, 30, 100, 300)
SETTLE = 300
"""Number of frames in which the clocks and windows of a new core settle. They are not measured."""
ROUNDS, QUICK_ROUNDS = 15, 3
BLOCK = 100
"""Number of frames whose mean CPU time is one measurement."""
FRAMES, QUICK_FRAMES = 1_000_000, 3_000
"""Number of frames of a full run and of a short run. The cost of a frame must not grow during a
run. A full run is 2.8 hours at 100 Hz."""
DRIFT, SHORT_DRIFT, DRIFT_TARGET = 0.1, 0.5, 0.02
"""Limits for the absolute value of the exponent in run time: threshold of a full run, threshold of
a short run, and target."""
LARGEST = 1.05
"""Threshold of the exponents in sensors, segments and markers."""


class LoadedCore:
    """A core, its rig, and the number of the next frame."""

    def __init__(self, rig: GrowingRig) -> None:
        self._rig = rig
        self.core = Core()
        configured = rig.rig()
        calibration = rig.calibration(configured.chain)
        assert calibration.fits(configured.chain)
        self.core.feed(Configured(BEGIN_NS, configured, calibration, 1))
        for source in configured.sources:
            self.core.feed(SourceOpened(BEGIN_NS, source.id))
        for event in rig.opening():
            self.core.feed(event)
        self._next = 0

    def cpu_s(self, count: int) -> float:
        """Process `count` frames; return the mean CPU time of a frame, s."""
        core, states, spent = self.core, 0, 0.0
        for events in self._frames(count):
            began = time.thread_time()
            for event in events:
                outputs = core.feed(event)
                _ = core.next_deadline_ns  # the runner reads the deadline after every event
                states += sum(isinstance(output, LimbState) for output in outputs)
            spent += time.thread_time() - began
        assert abs(states - count) <= 3, f"{states} limb states of {count} frames"
        return spent / count

    def instructions(self, count: int) -> float:
        """Process `count` frames; return the mean number of interpreted instructions of a frame."""
        frames, feed = self._frames(count), self.core.feed
        return count_instructions(lambda: [feed(one) for each in frames for one in each]) / count

    def _frames(self, count: int) -> list[list[ChunkArrived]]:
        frames = [self._rig.frame(k) for k in range(self._next, self._next + count)]
        self._next += count
        return frames


def frame_costs(rigs: Mapping[int, GrowingRig], rounds: int) -> dict[int, float]:
    """Return the CPU time of a frame, s, by size; the sizes are measured in turns."""
    cores = {size: LoadedCore(rig) for size, rig in rigs.items()}
    for core in cores.values():
        core.cpu_s(SETTLE)
    times: dict[int, list[float]] = {size: [] for size in rigs}
    gc.collect()
    gc.disable()
    try:
        for _ in range(rounds):
            for size, core in cores.items():
                times[size].append(core.cpu_s(BLOCK))
    finally:
        gc.enable()
    return {size: statistics.median(found) for size, found in times.items()}


def size_rows(
    name: str,
    make: Callable[[int], GrowingRig],
    sizes: tuple[int, ...],
    quick: bool,
) -> list[Result]:
    """Return the growth exponent, the cost of one more item at the largest size, and all costs."""
    costs = frame_costs({size: make(size) for size in sizes}, QUICK_ROUNDS if quick else ROUNDS)
    us = [1e6 * costs[size] for size in sizes]
    found = growth_exponent(sizes, us)
    step = (us[-1] - us[-2]) / (sizes[-1] - sizes[-2])
    return [
        # A short run has too few frames for `LARGEST`. It detects only a very large growth.
        Result(
            f"{name}: exponent", round(found.value, 3), 1.5 if quick else LARGEST, unit="",
            note=f"± {found.half_width:.3f}, {sizes[0]} to {sizes[-1]}",
        ),
        timed_result(f"{name}: one more of {sizes[-1]}", round(step, 2), "µs a frame"),
        *(
            timed_result(f"{name}: {size}", round(cost, 1), "µs a frame")
            for size, cost in zip(sizes, us, strict=True)
        ),
    ]  # fmt: skip


def memory_rows(quick: bool) -> list[Result]:
    """Return the memory of the core per sensor, and the time to configure a core."""
    sizes = (1, 8, 32)
    kib, start_ms = [], []
    for size in sizes:
        rig = GrowingRig(1, size)
        LoadedCore(rig)  # warm up
        began = time.thread_time()
        core = LoadedCore(rig)
        start_ms.append(1e3 * (time.thread_time() - began))
        core.cpu_s(SETTLE if quick else 4 * SETTLE)
        core.core.health(BEGIN_NS)
        kib.append(held(core.core, 0.0).size / 1024)
    return [
        timed_result("memory: one sensor", round(kib[0], 1), "KiB"),
        timed_result(
            "memory: each further sensor", round((kib[-1] - kib[0]) / (sizes[-1] - sizes[0]), 1),
            "KiB", 40, 80,
        ),
        timed_result("start: rig and core of one sensor", round(start_ms[0], 2), "ms"),
        timed_result(
            f"start: rig and core of {sizes[-1]} sensors", round(start_ms[-1], 2), "ms", 50, 500
        ),
    ]  # fmt: skip


def sensor_rows(quick: bool) -> list[Result]:
    """Return the growth with the sensors of one segment, and the memory per sensor."""
    rows = size_rows("sensors of a segment", partial(GrowingRig, 1), SENSORS, quick)
    return rows + memory_rows(quick)


def segment_rows(quick: bool) -> list[Result]:
    """Return the growth with the number of segments, which have one sensor each."""
    return size_rows("segments", lambda count: GrowingRig(count, 1), SEGMENTS, quick)


def marker_rows(quick: bool) -> list[Result]:
    """Return the growth with the markers of a segment with one sensor.

    The last result is the time to configure a core with the most markers.
    """
    rows = size_rows("markers", lambda count: GrowingRig(1, 1, count), MARKERS, quick)
    rig = GrowingRig(1, 1, MARKERS[-1])
    began = time.thread_time()
    LoadedCore(rig)
    took_s = time.thread_time() - began
    name = f"start: rig and core of {MARKERS[-1]} markers"
    return [*rows, timed_result(name, round(1e3 * took_s, 1), "ms", 100, 1000)]


def run_time_rows(quick: bool) -> list[Result]:
    """Return the growth of a frame's CPU time and instructions with the number of earlier frames.

    The results are the two exponents of growth, and the instruction counts of single blocks. The
    time of each block of frames is divided by the time of a fixed loop just before the block, so
    the load of the machine cancels. The run is divided into intervals, each of them a third of a
    decade of frame numbers. A point of the regression is the median time of the blocks in one
    interval. The instructions are counted at the end of each interval.
    """
    core = LoadedCore(GrowingRig(1, 1))
    frames = QUICK_FRAMES if quick else FRAMES
    ages, costs, counts = [], [], []
    ladder = np.geomspace(BLOCK, frames, 1 + round(3 * np.log10(frames / BLOCK))).round()
    core.cpu_s(BLOCK)  # the clocks settle
    for begin, end in itertools.pairwise(ladder.astype(int).tolist()):
        times = []
        for _ in range(max(1, (end - begin) // BLOCK - 1)):
            loop = loop_s()
            times.append(core.cpu_s(BLOCK) / loop)
        counts.append(core.instructions(BLOCK))
        ages.append(0.5 * (begin + end))
        costs.append(statistics.median(times))

    rows = []
    for name, values in (("time", costs), ("interpreted instructions", counts)):
        found = log_slope(ages, values)
        note = f"{found.value:+.4f} ± {found.half_width:.4f}, {BLOCK} to {frames} frames"
        threshold = SHORT_DRIFT if quick else DRIFT
        title = f"run time: exponent of {name}"
        value = round(abs(found.value), 4)
        rows.append(timed_result(title, value, "", DRIFT_TARGET, threshold, note=note))
    for age, count in zip(ages, counts, strict=True):
        rows.append(timed_result(f"run time: frame {age:.0f}", round(count, 1), "instructions"))
    return rows


EXPERIMENTS = (
    speed_experiment("growth-run-time", "Growth with the frames of a run", run_time_rows),
    speed_experiment("growth-sensors", "Growth with the sensors of a segment", sensor_rows),
    speed_experiment("growth-segments", "Growth with the segments of a limb", segment_rows),
    speed_experiment("growth-markers", "Growth with the markers of a segment", marker_rows),
)
