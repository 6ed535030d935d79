"""The calibration session: start, end, refusal and abort of phases."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.calibration import CalibrationSettings, CalibrationTrial, FitResult
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import Chain, MocapFrame, MocapLayout
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationProgress,
    CalibrationReady,
    CalibrationStatus,
    CalibrationStored,
    CancelJob,
    FitJob,
    JobFinished,
    JobProgress,
    Notice,
    Reply,
    Request,
)

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Output

SENSORS = ("S1", "S2", "S3", "S4")
CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (SENSORS[:2], SENSORS[2:]))
MARKERS = {segment: tuple(f"{segment}{k}" for k in range(3)) for segment in CHAIN.segments}
SETTINGS = CalibrationSettings(
    static_s=3.0, align_s=4.0, functional_s=4.0, markers=MARKERS, plate="Plate"
)
SECOND = 1_000_000_000
LAYOUT = MocapLayout((), ())
PLAIN = Calibration(
    "mean", CHAIN.joints, CHAIN.segments, CHAIN.sensors, {}, {}, {}, quality={"still_s": 5.0}
)


NO_WORLDS: dict[str, object] = {"sensors": {}, "notes": []}


def session(*, mocap: bool = True) -> CalibrationSession:
    return CalibrationSession(CHAIN, SETTINGS, mocap=mocap, calibration=None)


def seen(t_ns: int) -> MocapFrame:
    nothing = np.zeros((0, 3))
    return MocapFrame(t_ns, 0, None, LAYOUT, nothing, nothing, np.zeros((0, 4)))


def ask(one: CalibrationSession, t_ns: int, phase: str, **more: object) -> list[Output]:
    return one.request(Request(t_ns, "calibrate", "t", {"phase": phase, **more}))


def turned(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


def feed(
    one: CalibrationSession,
    start_s: float,
    end_s: float,
    speed: float = 0.0,
    *,
    sensors: tuple[str, ...] = SENSORS,
    cameras: bool = True,
    exchanged_labels: tuple[str, ...] = (),
) -> list[Output]:
    """Send samples at 50 Hz of sensors that turn at `speed` rad/s, and mocap frames."""
    out: list[Output] = []
    for k in range(round(start_s * 50), round(end_s * 50)):
        t_ns = k * SECOND // 50
        for sensor in sensors:
            out += one.add_sample(sensor, t_ns, turned(speed * k / 50))
        if cameras:
            one.add_mocap(t_ns, seen(t_ns))
        out += one.advance(t_ns, exchanged_labels)
    return out


def only(outputs: list[Output], kind: type[Any]) -> list[Any]:
    return [output for output in outputs if isinstance(output, kind)]


def done(one: CalibrationSession, job: FitJob, **result: object) -> list[Output]:
    return one.finish_job(JobFinished(99 * SECOND, job.job, FitResult.from_dict(result), None))


def posed() -> CalibrationSession:
    one = session()
    ask(one, 0, "static")
    (job,) = only(feed(one, 0, 10), FitJob)
    done(one, job, quality={})
    return one


def test_every_request_has_exactly_one_reply() -> None:
    one = session()
    for phase in ("nonsense", "functional", "align", "static", "abort"):
        assert len(only(ask(one, 0, phase), Reply)) == 1


def test_functional_phase_without_static_pose_is_refused_with_the_remedy() -> None:
    (reply,) = only(ask(session(), 0, "functional"), Reply)
    assert reply.status == "error"
    assert "static" in str(reply.error)


@pytest.mark.parametrize("phase", ["align", "functional"])
def test_phases_that_need_mocap_are_refused_without_it(phase: str) -> None:
    (reply,) = only(ask(session(mocap=False), 0, phase), Reply)
    assert "[mocap]" in str(reply.error)


def test_stillness_ends_the_static_phase_and_only_it_is_fitted() -> None:
    one = session()
    ask(one, 0, "static")
    moving = feed(one, 0, 4, speed=0.5)
    assert not only(moving, FitJob)
    (job,) = only(feed(one, 4, 12), FitJob)
    trial = job.work.static
    assert isinstance(trial, CalibrationTrial)
    span_s = (trial.sensors["S1"].t_ns[-1] - trial.sensors["S1"].t_ns[0]) / SECOND
    assert span_s == pytest.approx(SETTINGS.static_s, abs=0.5)
    assert trial.sensors["S1"].t_ns[0] > 4 * SECOND


def test_movement_restarts_the_static_phase_and_names_the_sensor() -> None:
    one = session()
    ask(one, 0, "static")
    feed(one, 0, 2.5)
    outputs = feed(one, 2.5, 3.5, speed=1.0)
    assert any(notice.id in SENSORS for notice in only(outputs, Notice))
    assert not only(feed(one, 3.5, 5.0), FitJob)


def test_static_phase_without_stillness_is_aborted_with_the_reason() -> None:
    one = session()
    ask(one, 0, "static")
    statuses = only(feed(one, 0, 125, speed=0.5), CalibrationStatus)
    assert statuses[-1].phase == "aborted"
    assert "moving" in statuses[-1].text


def test_static_phase_is_rejected_while_labels_are_exchanged_unless_forced() -> None:
    one = posed()
    assert one.status(0, "").done == ("static",)
    for force in (False, True):
        ask(one, 20 * SECOND, "static", force=force)
        outputs = feed(one, 20, 30, exchanged_labels=("T1 and T2 look exchanged",))
        assert len(only(outputs, FitJob)) == force
        if not force:
            (status,) = only(outputs, CalibrationStatus)
            assert status.phase == "aborted"
            assert "T1 and T2 look exchanged. Correct the labels" in status.text
            assert status.done == ()


def test_progress_is_published_at_most_five_times_a_second() -> None:
    one = posed()
    ask(one, 10 * SECOND, "functional")
    outputs = only(feed(one, 10, 13, speed=0.3), CalibrationProgress)
    assert 10 <= len(outputs) <= 15
    assert [p.progress for p in outputs] == sorted(p.progress for p in outputs)


def test_second_request_during_a_phase_is_refused() -> None:
    one = session()
    ask(one, 0, "align")
    (reply,) = only(ask(one, 1, "static"), Reply)
    assert reply.status == "error"
    assert "abort" in str(reply.error)


def test_abort_cancels_the_worker_and_its_late_result_is_ignored() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(feed(one, 0, 6), FitJob)
    assert only(ask(one, 7 * SECOND, "abort"), CancelJob) == [CancelJob(job.job)]
    assert done(one, job, alignment={}, quality={}) == []


def test_refused_fit_aborts_with_its_reason() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(feed(one, 0, 6), FitJob)
    statuses = only(
        done(one, job, refused="the plate turned about one axis only"), CalibrationStatus
    )
    assert statuses[-1].phase == "aborted"
    assert "one axis" in statuses[-1].text


def test_worse_calibration_is_rejected_with_the_reason() -> None:
    one = posed()
    ask(one, 10 * SECOND, "functional")
    (job,) = only(feed(one, 10, 16, speed=0.3), FitJob)
    outputs = done(
        one, job, calibration=PLAIN.to_dict(), worse="knee 3.0 against 1.0 deg", quality={}
    )
    assert not only(outputs, CalibrationReady)
    assert one.calibration is None
    (status,) = only(outputs, CalibrationStatus)
    assert "knee 3.0" in status.text
    assert (status.level, status.kept) == ("warning", "knee 3.0 against 1.0 deg")
    assert not only(outputs, Notice)  # no notice, because the status is also published as an event


def test_job_contains_the_alignment_of_the_session() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(feed(one, 0, 6), FitJob)
    done(one, job, alignment={"sensors": {}, "notes": []}, quality={})
    ask(one, 6 * SECOND, "static")
    (job,) = only(feed(one, 6, 16), FitJob)
    assert job.work.alignment == {"sensors": {}, "notes": []}


# --- missing data --------------------------------------------------------------------------------


def test_sensor_without_data_is_not_still_and_is_named() -> None:
    one = session()
    ask(one, 0, "static")
    out = feed(one, 0, 10, sensors=("S1", "S3", "S4"))
    assert not only(out, FitJob)
    assert "no data from S2" in only(out, CalibrationProgress)[-1].text
    assert only(feed(one, 10, 16), FitJob), "the phase continues with data of the sensor"


def test_stillness_ends_with_the_data_of_all_sensors() -> None:
    one = session()
    ask(one, 0, "static")
    feed(one, 0, 3)
    out = feed(one, 3, 10, sensors=())
    assert not only(out, FitJob)
    assert only(out, CalibrationProgress)[-1].progress == 0.0


def test_missing_data_during_movement_is_named() -> None:
    one = posed()
    ask(one, 10 * SECOND, "functional")
    out = feed(one, 10, 12, 0.3, sensors=("S1", "S2", "S3"), cameras=False)
    assert "no data from S4, the mocap system" in only(out, CalibrationProgress)[-1].text


def test_functional_phase_needs_mocap_data_of_the_static_pose() -> None:
    one = session()
    ask(one, 0, "static")
    (job,) = only(feed(one, 0, 10, cameras=False), FitJob)
    done(one, job, quality={})
    (reply,) = only(ask(one, 11 * SECOND, "functional"), Reply)
    assert "cameras" in str(reply.error)


# --- invalid requests ----------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", ["soon", "5", True, 0, -1.0, math.nan, math.inf, 601, [5]])
def test_invalid_seconds_are_refused(seconds: object) -> None:
    (reply,) = only(ask(session(), 0, "static", seconds=seconds), Reply)
    assert reply.status == "error"
    assert reply.error is not None
    assert reply.error["key"] == "seconds"


@pytest.mark.parametrize("phase", [None, 7, ["static"], {"phase": 1}])
def test_invalid_phases_are_refused(phase: Any) -> None:
    (reply,) = only(ask(session(), 0, phase), Reply)
    assert reply.status == "error"


def test_static_fit_uses_the_requested_length() -> None:
    one = session()
    ask(one, 0, "static", seconds=1.5)
    (job,) = only(feed(one, 0, 5), FitJob)
    assert job.work.settings.static_s == 1.5


def test_functional_fit_uses_the_requested_length_of_the_pose() -> None:
    """The fit must not refuse a pose that the static phase accepted."""
    one = session()
    ask(one, 0, "static", seconds=1.5)
    (job,) = only(feed(one, 0, 5), FitJob)
    done(one, job, quality={})
    reloaded = session()
    reloaded.resume(one, same_rig=True)
    for after in (one, reloaded):
        ask(after, 5 * SECOND, "functional")
        (job,) = only(feed(after, 5, 12), FitJob)
        assert job.work.settings.static_s == 1.5


# --- restarts and reloads ------------------------------------------------------------------------


def test_pose_of_an_aborted_fit_is_discarded() -> None:
    one = session()
    ask(one, 0, "static")
    feed(one, 0, 10)
    ask(one, 11 * SECOND, "abort")
    (reply,) = only(ask(one, 12 * SECOND, "functional"), Reply)
    assert reply.status == "error"


def test_sensor_restart_discards_the_pose_with_a_notice() -> None:
    one = posed()
    (notice,) = one.restart_sensor(11 * SECOND, "S2")
    assert isinstance(notice, Notice)
    assert notice.level == "warning"
    assert notice.text.startswith("restarted, so its heading may have changed")
    assert notice.text.endswith("Repeat the align phase, if you used it, and then the static pose")
    (reply,) = only(ask(one, 12 * SECOND, "functional"), Reply)
    assert "static" in str(reply.error)


def test_sensor_restart_aborts_the_phase() -> None:
    one = session()
    ask(one, 0, "align")
    feed(one, 0, 2)
    (status,) = only(one.restart_sensor(2 * SECOND, "S1"), CalibrationStatus)
    assert status.phase == "aborted"
    assert "S1 restarted" in status.text


def test_sensor_restart_without_calibration_gives_no_notice() -> None:
    assert session().restart_sensor(0, "S1") == []


@pytest.mark.parametrize("same_rig", [True, False])
def test_reload_preserves_alignment_and_pose_of_an_equal_rig(same_rig: bool) -> None:
    one, after = posed(), session()
    ask(one, 11 * SECOND, "align")
    (job,) = only(feed(one, 11, 17), FitJob)
    done(one, job, alignment={"sensors": {}, "notes": []}, quality={})
    after.resume(one, same_rig=same_rig)
    (reply, *_) = only(ask(after, 18 * SECOND, "functional"), Reply)
    assert reply.status == ("accepted" if same_rig else "error")
    if same_rig:
        (job,) = only(feed(after, 18, 24, 0.3), FitJob)
        assert job.work.alignment is not None


def test_job_numbers_are_unique_across_reloads() -> None:
    one, after = posed(), session()
    after.resume(one, same_rig=False)
    ask(after, 0, "static")
    (job,) = only(feed(after, 0, 10), FitJob)
    assert job.job == 2


def test_version_is_unknown_until_the_calibration_is_stored() -> None:
    one = CalibrationSession(CHAIN, SETTINGS, mocap=False, calibration=PLAIN, version=3)
    ask(one, 0, "static")
    (job,) = only(feed(one, 0, 10), FitJob)
    outputs = done(one, job, calibration=PLAIN.to_dict(), quality={})
    assert only(outputs, CalibrationStatus)[-1].version is None
    stored = CalibrationStored(100 * SECOND, 4, "2026-11-23T09:30:00+00:00")
    (status,) = only(one.set_stored_version(stored), CalibrationStatus)
    assert (status.version, status.created_utc) == (4, stored.created_utc)
    assert status.quality == PLAIN.quality


def test_status_names_the_phases_whose_results_the_movement_uses() -> None:
    one = posed()
    (status,) = only(ask(one, 11 * SECOND, "align"), CalibrationStatus)
    assert status.done == ("static",)
    outputs = feed(one, 11, 17)
    # The fit of the align phase is still running.
    assert only(outputs, CalibrationStatus)[-1].done == ("static",)
    (status,) = only(done(one, only(outputs, FitJob)[0], alignment=NO_WORLDS), CalibrationStatus)
    assert status.done == ("align", "static")
    (status,) = only(ask(one, 18 * SECOND, "static"), CalibrationStatus)
    assert status.done == ("align",)


def test_notes_of_the_alignment_are_published() -> None:
    one = session()
    ask(one, 0, "align")
    (job,) = only(feed(one, 0, 6), FitJob)
    notes = ["S1: heading only; turn the plate about more axes"]
    outputs = done(one, job, alignment={"sensors": {}, "notes": notes}, quality={})
    assert [notice.text for notice in only(outputs, Notice)] == notes


def test_progress_of_the_running_fit_is_published_and_that_of_others_is_not() -> None:
    one = session()
    ask(one, 0, "static")
    (job,) = only(feed(one, 0, 10), FitJob)
    text = "refining the markers of the chain model: error 5.1 mm"
    (progress,) = one.report_job(JobProgress(11 * SECOND, job.job, 0.51234, text))
    assert progress == CalibrationProgress(11 * SECOND, CalibrationPhase.FITTING, 0.512, text)
    assert one.report_job(JobProgress(11 * SECOND, job.job + 1, 0.5, text)) == []
    done(one, job, quality={})
    assert one.report_job(JobProgress(12 * SECOND, job.job, 0.9, text)) == []
