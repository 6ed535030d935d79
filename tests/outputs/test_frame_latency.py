"""Latency of frames by stage: histograms, marks of a core, and the callback of the outbox."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import hypothesis.strategies as st
from hypothesis import given

from bench.experiments.speed.core import START_NS
from bench.experiments.speed.core import events as sensor_events
from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.frame_latency import STAGES, FrameLatency, LatencyHistogram
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured

if TYPE_CHECKING:
    from jointfit_daemon.outputs.frame_latency import LatencyHealth

BUCKET = 1.25
"""Largest ratio between the limits of a bucket."""


MS = 1_000_000
STEP_NS = 100


class Clock:
    """A clock that the test sets, and that advances by `step_ns` with each reading."""

    def __init__(self, step_ns: int = 0) -> None:
        self.now_ns, self._step_ns = 0, step_ns

    def __call__(self) -> int:
        self.now_ns += self._step_ns
        return self.now_ns


def longest_ms(health: LatencyHealth) -> dict[str, float | None]:
    """Return the longest latency of each stage, ms."""
    return {
        name: None if stage is None else stage.max_ns / MS for name, stage in health.stages.items()
    }


@given(st.lists(st.integers(0, 50_000_000_000), min_size=1), st.floats(0.01, 1.0))
def test_a_quantile_exceeds_the_exact_one_by_at_most_a_bucket(times: list[int], p: float) -> None:
    histogram = LatencyHistogram()
    for ns in times:
        histogram.add(ns)
    exact = sorted(times)[max(0, math.ceil(p * len(times) - 1e-9) - 1)]
    found = histogram.quantile_ns(p)
    assert found is not None
    assert exact <= found <= max(BUCKET * exact, 1024) + 1024
    assert found <= histogram.longest_ns == max(times)


def test_times_outside_the_buckets_are_counted() -> None:
    histogram = LatencyHistogram()
    assert histogram.quantile_ns(0.5) is None
    for ns in (-5, 1 << 50):
        histogram.add(ns)
    assert histogram.total == sum(histogram.counts) == 2
    assert (histogram.counts[0], histogram.counts[-1]) == (1, 1)


def test_the_stages_of_a_frame_add_up() -> None:
    latency = FrameLatency(clock := Clock())
    clock.now_ns = 2 * MS
    latency.mark_decoded(1 * MS)
    clock.now_ns = 5 * MS
    latency.mark_aligned()
    clock.now_ns = 13 * MS
    latency.mark_fused(None)
    clock.now_ns = 29 * MS
    written = latency.mark_encoded()
    clock.now_ns = 61 * MS
    assert written is not None
    written()

    latency.end_interval()
    health = latency.health
    assert longest_ms(health) == {
        "decoded": 1, "aligned": 3, "fused": 8, "encoded": 16, "written": 32, "total": 60,
    }  # fmt: skip
    assert health.frames == 1
    latency.end_interval()
    assert latency.health.stages == dict.fromkeys(STAGES)


def test_frames_released_together_are_encoded_in_their_order() -> None:
    latency = FrameLatency(clock := Clock())
    clock.now_ns = 100 * MS
    latency.mark_decoded(99 * MS)  # a chunk of another frame, before the deadlines
    latency.mark_aligned()
    for deadline_ns in (60 * MS, 80 * MS):
        clock.now_ns += 1 * MS
        latency.mark_fused(deadline_ns)
    clock.now_ns = 110 * MS
    for written in (latency.mark_encoded(), latency.mark_encoded()):
        assert written is not None
        written()
    assert latency.mark_encoded() is None
    latency.end_interval()
    assert longest_ms(latency.health) == {
        "decoded": None, "aligned": 40, "fused": 2, "encoded": 9, "written": 0, "total": 50,
    }  # fmt: skip


def test_a_core_marks_every_frame_and_computes_the_same() -> None:
    events = [Configured(START_NS, bench_rig(), None), *sensor_events(100.0, 0.5)]
    latency = FrameLatency(clock := Clock(STEP_NS))
    plain, observed = Core(), Core()
    observed.stages = latency
    frames = 0
    for event in events:
        clock.now_ns = event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns
        outputs = observed.feed(event)
        assert repr(outputs) == repr(plain.feed(event))
        for output in outputs:
            if isinstance(output, LimbState):
                frames += 1
                assert latency.mark_encoded() is not None
        assert latency.mark_encoded() is None

    assert frames > 30
    latency.end_interval()
    health = latency.health
    assert health.frames == frames
    step_ms = STEP_NS / MS  # each stage ends with one reading of the clock
    assert {longest_ms(health)[stage] for stage in ("decoded", "aligned", "fused")} == {step_ms}
