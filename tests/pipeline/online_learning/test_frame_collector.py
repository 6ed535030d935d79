"""What the cameras teach while it runs: which frames are kept, and what becomes of a refit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jointfit_daemon.calibration import CalibrationSettings
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
from jointfit_daemon.pipeline.online_learning import OnlineLearner, _frame_collector, models_only
from jointfit_daemon.timing.alignment import AlignedFrame
from tests.calibration.calibrated_subject import CHAIN, calibration, fresh, moving

MS, S = 1_000_000, 1_000_000_000
SENSORS = ("S1", "S2", "S3")
LAYOUT = MocapLayout(("A", "B", "C", "D"), ())
NOBODY: frozenset[str] = frozenset()


def turned(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


def seen(t_ns: int, *, hidden: bool = False) -> MocapFrame:
    markers = np.full((4, 3), t_ns / S)
    if hidden:
        markers[1] = np.nan
    return MocapFrame(t_ns, 0, None, LAYOUT, markers, np.zeros((0, 3)), np.zeros((0, 4)))


def aligned(t_ns: int, angle: float, *, synced: bool = True, missing: str = "") -> AlignedFrame:
    said = {name: turned(angle) for name in SENSORS if name != missing}
    return AlignedFrame(t_ns, t_ns, said, NOBODY, NOBODY, synced)


def learner(*, wanted: bool = True, **changed: Any) -> OnlineLearner:
    return OnlineLearner(CHAIN, replace(calibration(), **changed), wanted=wanted)


def wear(one: OnlineLearner, seconds: float, begin_s: float = 0.0, **how: Any) -> None:
    """Sensors at 100 Hz that turn by 1 rad/s, cameras at 100 Hz between them."""
    flags, hidden = how.pop("flags", ()), how.pop("hidden", False)
    speed, cameras = how.pop("speed", 1.0), how.pop("cameras", True)
    for k in range(round(begin_s * 100), round((begin_s + seconds) * 100)):
        t_ns = k * 10 * MS
        if cameras:
            one.add_mocap(t_ns - 4 * MS, seen(t_ns - 4 * MS, hidden=hidden))
        one.add_frame(aligned(t_ns, speed * t_ns / S, **how), flags)


def test_ten_frames_a_second_are_kept_while_moving() -> None:
    one = learner()
    wear(one, 10.0)
    assert one.kept == pytest.approx(100, abs=2)


def test_a_posture_held_is_kept_once_a_second() -> None:
    one = learner()
    wear(one, 10.0, speed=0.0)
    assert one.kept == pytest.approx(10, abs=1)


def test_sensors_are_read_at_the_instant_of_the_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frame_collector, "ENOUGH", 10)
    one = learner()
    wear(one, 3.0)
    assert one.due(3 * S) is None  # the rest begins
    taken = one.due(3 * S + _frame_collector.REST_NS)
    assert taken is not None
    assert one.kept == 0
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
def test_nothing_is_kept_of_frames_that_are_not_whole(how: dict[str, Any]) -> None:
    one = learner()
    wear(one, 3.0, **how)
    assert one.kept == 0


def test_untrained_postures_are_what_is_wanted() -> None:
    one = learner()
    wear(one, 3.0, flags=("untrained:thigh",))
    assert one.kept > 20


def test_no_calibration_no_memory_no_wish_no_learning() -> None:
    for one in (learner(wanted=False), learner(memory=""), learner(clusters={})):
        wear(one, 2.0)
        assert not one.active
        assert one.kept == 0
    assert not OnlineLearner(CHAIN, None, wanted=True).active


def test_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frame_collector, "MOST", 50)
    one = learner()
    wear(one, 10.0)
    assert one.kept == 50


def test_a_camera_clock_that_begins_anew_throws_away_what_was_kept() -> None:
    one = learner()
    wear(one, 3.0)
    one.add_mocap(3 * S + 200 * MS, seen(3 * S), epoch=1)
    assert one.kept == 0


def test_refits_are_three_minutes_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_frame_collector, "ENOUGH", 10)
    one = learner()
    wear(one, 3.0)
    asked = []
    for second in range(3, 400):
        if one.due(second * S) is not None:
            asked.append(second)
            wear(one, 2.0, 3.0 + 10 * len(asked))
    assert asked == [183, 363]


# --- what becomes of a refit ------------------------------------------------------------------


def session() -> CalibrationSession:
    settings = CalibrationSettings(learn_online=True)
    return CalibrationSession(CHAIN, settings, mocap=True, calibration=calibration(), version=4)


def only(outputs: list[Output], kind: type[Any]) -> list[Any]:
    return [output for output in outputs if isinstance(output, kind)]


def asked(one: CalibrationSession) -> FitJob:
    (job,) = only(one.learn(fresh(moving(50, 1.0))), FitJob)
    assert isinstance(job, FitJob)
    return job


def better() -> dict[str, Any]:
    models = calibration().segment
    swapped = {name: replace(item, models={}) for name, item in models.items()}
    found = replace(
        calibration(),
        segment=swapped,
        quality={"online": {"frames": 7}},
        memory="x",
        correlations={"knee": -0.25},
    )
    return {"calibration": found.to_dict(), "quality": dict(found.quality)}


def finish(one: CalibrationSession, job: int, result: dict[str, Any]) -> list[Output]:
    return one.job_finished(JobFinished(9 * S, job, result, None))


def test_what_is_better_is_taken_told_and_stored_with_where_it_came_from() -> None:
    one = session()
    job = asked(one)
    assert job.kind == "online"
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
    assert models_only(calibration(), one.calibration)
    assert one.may_learn


@pytest.mark.parametrize("result", [{"kept": "no better"}, {"refused": "markers"}, {}])
def test_what_is_not_better_changes_nothing_and_says_why(result: dict[str, Any]) -> None:
    one = session()
    before = one.calibration
    out = finish(one, asked(one).job, result)
    assert one.calibration is before
    assert one.version == 4
    (notice,) = only(out, Notice)
    assert notice.text.startswith("nothing learned: ")
    assert one.may_learn


def test_a_pose_that_is_fitted_meanwhile_cancels_the_refit() -> None:
    one = session()
    job = asked(one)
    one.request(Request(S, "calibrate", "t", {"phase": "static", "seconds": 2.0}))
    out: list[Output] = []
    for k in range(400):
        t_ns = S + k * S // 50
        for sensor in SENSORS:
            out += one.add_sample(sensor, t_ns, turned(0.0))
        out += one.advance(t_ns)
    assert [found.kind for found in only(out, FitJob)] == ["static"]
    before = one.calibration
    assert finish(one, job.job, better()) == []
    assert one.calibration is before


def unlearn(one: CalibrationSession) -> list[Output]:
    return one.request(Request(S, "calibrate", "t", {"phase": "unlearn"}))


def test_what_was_learned_can_be_taken_back_and_stays_away() -> None:
    one = session()
    finish(one, asked(one).job, better())
    out = unlearn(one)
    (reply,) = only(out, Reply)
    assert reply.status == "ok"
    assert one.calibration == calibration()
    (ready,) = only(out, CalibrationReady)
    assert ready.calibration == calibration()
    assert not one.may_learn


def test_where_nothing_was_learned_nothing_is_taken_back() -> None:
    (reply,) = only(unlearn(session()), Reply)
    assert reply.status == "error"
