"""The calibration session: phases begin, end, refuse and abort as the wearer is told they do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.calibration.trial import CalibrationSettings, CalibrationTrial
from jointfit_daemon.model import Chain
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationReady,
    CalibrationStatus,
    CancelJob,
    FitJob,
    JobFinished,
    Notice,
    Reply,
    Request,
)
from jointfit_daemon.pipeline.session import CalibrationSession

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Output

SENSORS = ("S1", "S2", "S3", "S4")
CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (SENSORS[:2], SENSORS[2:]))
SETTINGS = CalibrationSettings(static_s=3.0, align_s=4.0, functional_s=4.0)
SECOND = 1_000_000_000
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def session(*, mocap: bool = True) -> CalibrationSession:
    return CalibrationSession(CHAIN, SETTINGS, mocap=mocap, calibration=None)


def ask(one: CalibrationSession, t_ns: int, phase: str, **more: object) -> list[Output]:
    return one.request(Request(t_ns, "calibrate", "t", {"phase": phase, **more}))


def turned(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


def wear(one: CalibrationSession, start_s: float, end_s: float, speed: float = 0.0) -> list[Output]:
    """Feed all sensors at 50 Hz, turning at `speed` rad/s, and let time go on."""
    out: list[Output] = []
    for k in range(round(start_s * 50), round(end_s * 50)):
        t_ns = k * SECOND // 50
        for sensor in SENSORS:
            out += one.add_sample(sensor, t_ns, turned(speed * k / 50))
        out += one.advance(t_ns)
    return out


def only(outputs: list[Output], kind: type[Any]) -> list[Any]:
    return [output for output in outputs if isinstance(output, kind)]


def done(one: CalibrationSession, job: FitJob, **result: object) -> list[Output]:
    return one.job_finished(JobFinished(99 * SECOND, job.job, result, None))


def posed() -> CalibrationSession:
    one = session()
    ask(one, 0, "static")
    (job,) = only(wear(one, 0, 10), FitJob)
    done(one, job, quality={})
    return one


def test_every_request_is_answered_exactly_once() -> None:
    one = session()
    for phase in ("nonsense", "functional", "align", "static", "abort"):
        assert len(only(ask(one, 0, phase), Reply)) == 1


def test_a_functional_phase_without_a_static_pose_says_what_comes_first() -> None:
    (reply,) = only(ask(session(), 0, "functional"), Reply)
    assert reply.status == "error"
    assert "static" in str(reply.error)


@pytest.mark.parametrize("phase", ["align", "functional"])
def test_without_cameras_the_phases_that_need_them_are_refused(phase: str) -> None:
    (reply,) = only(ask(session(mocap=False), 0, phase), Reply)
    assert "[mocap]" in str(reply.error)


def test_standing_still_ends_the_static_phase_and_hands_over_only_the_still_part() -> None:
    one = session()
    ask(one, 0, "static")
    moving = wear(one, 0, 4, speed=0.5)
    assert not only(moving, FitJob)
    (job,) = only(wear(one, 4, 12), FitJob)
    trial = job.payload["static"]
    assert isinstance(trial, CalibrationTrial)
    span_s = (trial.sensors["S1"].t_ns[-1] - trial.sensors["S1"].t_ns[0]) / SECOND
    assert span_s == pytest.approx(SETTINGS.static_s, abs=0.5)
    assert trial.sensors["S1"].t_ns[0] > 4 * SECOND


def test_movement_restarts_the_static_clock_and_names_the_sensor() -> None:
    one = session()
    ask(one, 0, "static")
    wear(one, 0, 2.5)
    told = wear(one, 2.5, 3.5, speed=1.0)
    assert any(notice.id in SENSORS for notice in only(told, Notice))
    assert not only(wear(one, 3.5, 5.0), FitJob)


def test_a_wearer_who_never_stands_still_gets_the_reason() -> None:
    one = session()
    ask(one, 0, "static")
    statuses = only(wear(one, 0, 125, speed=0.5), CalibrationStatus)
    assert statuses[-1].phase == "aborted"
    assert "moving" in statuses[-1].text


def test_progress_is_told_at_most_five_times_a_second() -> None:
    one = posed()
    ask(one, 10 * SECOND, "functional")
    told = only(wear(one, 10, 13, speed=0.3), CalibrationProgress)
    assert 10 <= len(told) <= 15
    assert [p.progress for p in told] == sorted(p.progress for p in told)


def test_a_second_request_while_a_phase_runs_is_refused() -> None:
    one = session()
    ask(one, 0, "align")
    (reply,) = only(ask(one, 1, "static"), Reply)
    assert reply.status == "error"
    assert "abort" in str(reply.error)


def test_abort_cancels_the_worker_and_its_late_result_is_ignored() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(wear(one, 0, 6), FitJob)
    assert only(ask(one, 7 * SECOND, "abort"), CancelJob) == [CancelJob(job.job)]
    assert done(one, job, alignment={}, quality={}) == []


def test_a_refusal_of_the_fit_aborts_with_its_reason() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(wear(one, 0, 6), FitJob)
    statuses = only(done(one, job, refused="the plate turned about one axis only"), CalibrationStatus)
    assert statuses[-1].phase == "aborted"
    assert "one axis" in statuses[-1].text


def test_a_worse_calibration_is_not_taken_and_the_reason_is_told() -> None:
    one = posed()
    ask(one, 10 * SECOND, "functional")
    (job,) = only(wear(one, 10, 16, speed=0.3), FitJob)
    outputs = done(one, job, calibration={"schema": 1}, worse="knee 3.0 against 1.0 deg", quality={})
    assert not only(outputs, CalibrationReady)
    assert one.calibration is None
    assert any("knee 3.0" in notice.text for notice in only(outputs, Notice))


def test_the_payload_carries_the_alignment_of_this_session() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(wear(one, 0, 6), FitJob)
    done(one, job, alignment={"sensors": {}, "notes": []}, quality={})
    ask(one, 6 * SECOND, "static")
    (job,) = only(wear(one, 6, 16), FitJob)
    assert job.payload["alignment"] == {"sensors": {}, "notes": []}
