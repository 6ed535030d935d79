"""Online learning from bytes to a better calibration, in the real worker process."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStored,
    Configured,
    FitJob,
    JobFinished,
    SourceOpened,
)
from jointfit_daemon.pipeline.online_learning import _frame_collector
from jointfit_daemon.supervisor._fit_runner import FitRunner
from jointfit_protocols.natnet import Body, FrameOfData
from jointfit_protocols.natnet import encode as encode_natnet
from tests.calibration.calibrated_subject import TWO_AND_TWO, calibration, moving
from tests.outputs.recording.recorded_events import after_recording
from tests.pipeline import core_feed
from tests.pipeline.core_feed import BEGIN_NS, PERIOD_NS, SENSORS, Bench, chunk, replay_states

if TYPE_CHECKING:
    from jointfit_daemon.model import LimbState
    from jointfit_daemon.pipeline.events import Event

FRAMES, MORE = 1615, 200
BENDING = moving(FRAMES + MORE, 1.2, 1, TWO_AND_TWO, rate_hz=100.0)


def orientation(name: str, number: int) -> tuple[float, ...]:
    return tuple(BENDING.sensors[name][number].tolist())


def camera_bytes(number: int) -> bytes:
    """Return a frame of two rigid bodies with the orientations of the bones."""
    bodies = []
    for label, q in enumerate(BENDING.reference.values(), 1):
        w, x, y, z = q[number].tolist()
        bodies.append(Body(label, 0.1, 0.2, 1.0, x, y, z, w, 0.0, 1))
    ticks = number * 100_000
    return encode_natnet(
        FrameOfData(number, 0.0, ticks, ticks + 1, ticks + 2, 0, tuple(bodies)), (3, 0)
    )


def opening(*, wanted: bool) -> list[Event]:
    table = core_feed.table() | {"calibration": {"learn_online": wanted}}
    table["mocap"] = table["mocap"] | {"up_axis": "z"}
    rig = parse_rig(table)
    assert rig.chain.sensors == TWO_AND_TWO.sensors
    worn = calibration(rig.chain, bodies=True)
    events: list[Event] = [Configured(BEGIN_NS, rig, worn, 3)]
    events += [SourceOpened(BEGIN_NS, source.id) for source in rig.sources]
    return events + core_feed.camera_hello(BEGIN_NS)


def moved(first: int, last: int, *, cameras: bool = True) -> list[Event]:
    names = (*SENSORS, "mocap") if cameras else SENSORS
    return sorted(
        (chunk(name, k) for k in range(first, last) for name in names), key=core_feed.arrival_ns
    )


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core_feed, "orientation", orientation)
    monkeypatch.setattr(core_feed, "camera_bytes", camera_bytes)
    monkeypatch.setattr(_frame_collector, "MIN_FRAMES", 340)
    monkeypatch.setattr(_frame_collector, "INTERVAL_NS", 30_000_000)
    monkeypatch.setattr(_frame_collector, "POSTURE_COSINE", 2.0)
    monkeypatch.setattr(_frame_collector, "REFIT_NS", 100_000_000)


async def answered(bench: Bench, job: FitJob) -> None:
    """Run the job in the worker, and feed its result at the time of the last event."""
    said: list[Event] = []
    async with asyncio.TaskGroup() as tasks:
        FitRunner(tasks, said.append).start(job)
    (event,) = said
    assert isinstance(event, JobFinished)
    bench.feed([replace(event, t_ns=core_feed.arrival_ns(bench.fed[-1]))])


def error(states: list[LimbState]) -> float:
    """Return the RMS error of the thigh, rad."""
    said = np.array([state.segments[0].q_world_segment for state in states])
    rows = [round((state.t_ns - BEGIN_NS) / PERIOD_NS) for state in states]
    true = BENDING.reference["thigh"][np.clip(rows, 0, FRAMES + MORE - 1)]
    return float(np.sqrt(np.mean(rotation.angle_between(said, true) ** 2)))


@pytest.mark.real_time
@pytest.mark.timeout(120)
async def test_online_learning_improves_the_calibration_and_replays_identically() -> None:
    bench = Bench()
    bench.feed([*opening(wanted=True), *moved(0, FRAMES)])
    (job,) = (out for out in bench.out if isinstance(out, FitJob))
    before = bench.states[-MORE:]
    await answered(bench, job)
    (ready,) = (out for out in bench.out if isinstance(out, CalibrationReady))
    assert ready.calibration.quality["online"]["from_version"] == 3
    bench.feed([CalibrationStored(core_feed.arrival_ns(bench.fed[-1]), 4)])
    told = len(bench.states)
    bench.feed(moved(FRAMES, FRAMES + MORE))
    assert error(bench.states[-MORE // 2 :]) < 0.6 * error(before)
    around = [state.segments[0].q_world_segment for state in bench.states[told - 20 : told + 20]]
    steps = [rotation.angle_between(np.array(a), np.array(b)) for a, b in pairwise(around)]
    assert max(steps[19:21]) < 1.5 * max(steps[:19])  # no jump at the change of the models
    logged = after_recording(bench.fed)
    assert replay_states(logged) == bench.states


@pytest.mark.parametrize(("wanted", "cameras"), [(False, True), (True, False)])
def test_no_learning_job_without_cameras_or_if_disabled(wanted: bool, cameras: bool) -> None:
    bench = Bench()
    bench.feed([*opening(wanted=wanted), *moved(0, FRAMES, cameras=cameras)])
    assert not [out for out in bench.out if isinstance(out, FitJob)]
