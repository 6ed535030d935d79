"""Online learning: selection of frames, outcome of refits, and reversion."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jointfit_daemon.calibration import CalibrationSettings, FitResult, RefitJob
from jointfit_daemon.kinematics.rotation_scalar import angle_between_one
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStatus,
    FitJob,
    JobFinished,
    Notice,
    Output,
    Reply,
    Request,
)
from jointfit_daemon.pipeline.online_learning import (
    OnlineFrameCollector,
    _frame_collector,
    only_models_differ,
)
from jointfit_daemon.timing.alignment import AlignedFrame
from tests.calibration.calibrated_subject import CHAIN, calibration, fresh, moving

MS, S = 1_000_000, 1_000_000_000
SENSORS = ("S1", "S2", "S3")
LAYOUT = MocapLayout(("A", "B", "C", "D"), ())
NO_SENSORS: frozenset[str] = frozenset()


def turned(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


def seen(t_ns: int, *, hidden: bool = False) -> MocapFrame:
    markers = np.full((4, 3), t_ns / S)
    if hidden:
        markers[1] = np.nan
    return MocapFrame(t_ns, 0, None, LAYOUT, markers, np.zeros((0, 3)), np.zeros((0, 4)))


def aligned(t_ns: int, angle: float, *, synced: bool = True, missing: str = "") -> AlignedFrame:
    said = {name: turned(angle) for name in SENSORS if name != missing}
    return AlignedFrame(t_ns, t_ns, said, NO_SENSORS, NO_SENSORS, synced)


def collector(*, wanted: bool = True, **changed: Any) -> OnlineFrameCollector:
    return OnlineFrameCollector(CHAIN, replace(calibration(), **changed), wanted=wanted)


def feed(one: OnlineFrameCollector, seconds: float, begin_s: float = 0.0, **how: Any) -> None:
    """Feed samples of sensors that turn at 1 rad/s, and mocap frames in between, at 100 Hz each."""
    flags, hidden = how.pop("flags", ()), how.pop("hidden", False)
    speed, cameras = how.pop("speed", 1.0), how.pop("cameras", True)
    for k in range(round(begin_s * 100), round((begin_s + seconds) * 100)):
        t_ns = k * 10 * MS
        if cameras:
            one.add_mocap(t_ns - 4 * MS, seen(t_ns - 4 * MS, hidden=hidden))
        one.add_frame(aligned(t_ns, speed * t_ns / S, **how), flags)


def test_ten_frames_a_second_are_collected_in_movement() -> None:
    one = collector()
    feed(one, 10.0)
    assert one.health(0).kept == pytest.approx(100, abs=2)


def test_held_posture_is_collected_once_a_second() -> None:
    one = collector()
    feed(one, 10.0, speed=0.0)
    assert one.health(0).kept == pytest.approx(10, abs=1)


def test_sensors_are_interpolated_at_the_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frame_collector, "MIN_FRAMES", 10)
    one = collector()
    feed(one, 3.0)
    assert one.take_due(3 * S) is None  # the waiting time starts
    taken = one.take_due(3 * S + _frame_collector.REFIT_NS)
    assert taken is not None
    assert one.health(0).kept == 0
    for q, markers in zip(taken.sensors["S2"], taken.markers["thigh"], strict=True):
        assert angle_between_one(tuple(q), turned(float(markers[0, 0]))) < 1e-6


@pytest.mark.parametrize(
    "how",
    [
        {"cameras": False},
        {"hidden": True},
        {"synced": False},
        {"missing": "S2"},
        {"flags": ("untrained:thigh", "slipped:S1")},
    ],
)
def test_incomplete_or_faulty_frames_are_not_collected(how: dict[str, Any]) -> None:
    one = collector()
    feed(one, 3.0, **how)
    assert one.health(0).kept == 0


def test_postures_outside_the_training_range_are_collected() -> None:
    one = collector()
    feed(one, 3.0, flags=("untrained:thigh",))
    assert one.health(0).kept > 20


def test_collector_is_inactive_without_calibration_memory_or_setting() -> None:
    for one in (collector(wanted=False), collector(memory=""), collector(clusters={})):
        feed(one, 2.0)
        assert not one.active
        assert one.health(0).kept == 0
    assert not OnlineFrameCollector(CHAIN, None, wanted=True).active


def test_collection_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frame_collector, "MAX_FRAMES", 50)
    one = collector()
    feed(one, 10.0)
    assert one.health(0).kept == 50


def test_restart_of_the_mocap_clock_clears_the_collection() -> None:
    one = collector()
    feed(one, 3.0)
    one.add_mocap(3 * S + 200 * MS, seen(3 * S), epoch=1)
    assert one.health(0).kept == 0


def test_refits_are_at_least_three_minutes_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frame_collector, "MIN_FRAMES", 10)
    one = collector()
    feed(one, 3.0)
    asked = []
    for second in range(3, 400):
        if one.take_due(second * S) is not None:
            asked.append(second)
            feed(one, 2.0, 3.0 + 10 * len(asked))
    assert asked == [183, 363]


# --- outcome of a refit ------------------------------------------------------------------


def session() -> CalibrationSession:
    settings = CalibrationSettings(learn_online=True)
    return CalibrationSession(CHAIN, settings, mocap=True, calibration=calibration(), version=4)


def only(outputs: list[Output], kind: type[Any]) -> list[Any]:
    return [output for output in outputs if isinstance(output, kind)]


def asked(one: CalibrationSession) -> FitJob:
    (job,) = only(one.request_refit(fresh(moving(50, 1.0))), FitJob)
    assert isinstance(job, FitJob)
    return job


def better() -> FitResult:
    models = calibration().segment
    swapped = {name: replace(item, models={}) for name, item in models.items()}
    found = replace(
        calibration(),
        segment=swapped,
        quality={"online": {"frames": 7}},
        memory="x",
        correlations={"knee": -0.25},
    )
    return FitResult(found.quality, calibration=found)


def finish(one: CalibrationSession, job: int, result: FitResult | None) -> list[Output]:
    return one.finish_job(JobFinished(9 * S, job, result, None))


def test_better_models_are_used_reported_and_stored_with_their_origin() -> None:
    one = session()
    job = asked(one)
    assert isinstance(job.work, RefitJob)
    assert not one.may_learn
    out = finish(one, job.job, better())
    (ready,) = only(out, CalibrationReady)
    assert ready.calibration.quality["online"] == {"frames": 7, "from_version": 4}
    assert ready.calibration is one.calibration
    (status,) = only(out, CalibrationStatus)
    assert status.phase == "calibrated"
    assert status.quality["online"]["frames"] == 7
    (notice,) = only(out, Notice)
    assert "7 frames" in notice.text
    assert one.calibration is not None
    assert only_models_differ(calibration(), one.calibration)
    assert one.may_learn


@pytest.mark.parametrize(
    "result", [FitResult(kept="no better"), FitResult(refused="markers"), None]
)
def test_models_that_are_not_better_are_rejected_with_the_reason(result: FitResult | None) -> None:
    one = session()
    before = one.calibration
    out = finish(one, asked(one).job, result)
    assert one.calibration is before
    assert one.version == 4
    (notice,) = only(out, Notice)
    assert notice.text.startswith("models unchanged: ")
    assert one.may_learn


def test_static_fit_cancels_the_refit() -> None:
    one = session()
    job = asked(one)
    one.request(Request(S, "calibrate", "t", {"phase": "static", "seconds": 2.0}))
    out: list[Output] = []
    for k in range(400):
        t_ns = S + k * S // 50
        for sensor in SENSORS:
            out += one.add_sample(sensor, t_ns, turned(0.0))
        out += one.advance(t_ns)
    assert [found.work.name for found in only(out, FitJob)] == ["static"]
    before = one.calibration
    assert finish(one, job.job, better()) == []
    assert one.calibration is before


def revert(one: CalibrationSession) -> list[Output]:
    return one.request(Request(S, "calibrate", "t", {"phase": "revert"}))


def test_online_learning_can_be_reverted_and_is_then_paused() -> None:
    one = session()
    finish(one, asked(one).job, better())
    out = revert(one)
    (reply,) = only(out, Reply)
    assert reply.status == "ok"
    assert one.calibration == calibration()
    (ready,) = only(out, CalibrationReady)
    assert ready.calibration == calibration()
    assert not one.may_learn


def test_revert_without_online_learning_is_refused() -> None:
    (reply,) = only(revert(session()), Reply)
    assert reply.status == "error"
