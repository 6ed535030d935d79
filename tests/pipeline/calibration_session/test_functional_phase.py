"""The functional phase: its end, its progress, and the movements it reports as missing."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.calibration import FitResult
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.outputs.payloads._encoding import encode
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationStatus,
    FitJob,
    JobFinished,
    Notice,
    Reply,
    Request,
)
from tests.calibration.synthetic_limb import (
    CHAIN,
    SETTINGS,
    Imperfections,
    Subject,
    static_and_functional,
)
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from jointfit_daemon.calibration import CalibrationSettings, CalibrationTrial
    from jointfit_daemon.model import Quaternion
    from jointfit_daemon.pipeline.events import Output

SECOND = 1_000_000_000
QUICK = replace(
    SETTINGS, static_s=3.0, functional_s=60.0, functional_min_s=10.0, center_target_m=0.01
)


@cache
def trials() -> tuple[CalibrationTrial, CalibrationTrial]:
    static, functional, _ = static_and_functional(Subject(flaws=Imperfections(skin_m=0.002)))
    return static, functional


def play(one: CalibrationSession, trial: CalibrationTrial, begin_ns: int) -> list[Output]:
    """Feed a trial in order of time, from `begin_ns` on, until its phase ends."""
    assert trial.optical is not None
    track, layout = trial.optical, MocapLayout(trial.optical.markers, ())
    events: list[tuple[int, str, Quaternion | MocapFrame]] = [
        (t, sensor, (w, x, y, z))
        for sensor, said in trial.sensors.items()
        for t, (w, x, y, z) in zip(said.t_ns.tolist(), said.q_world_sensor.tolist(), strict=True)
    ]
    for i, t in enumerate(track.t_ns.tolist()):
        bodies = track.body_positions[i], track.body_orientations[i]
        frame = MocapFrame(t, i, None, layout, track.positions[i], *bodies)
        events.append((t, "mocap", frame))
    out: list[Output] = []
    for t, name, what in sorted(events, key=lambda event: event[:2]):
        if not one.collecting:
            break
        if isinstance(what, MocapFrame):
            one.add_mocap(begin_ns + t, what)
        else:
            out += one.add_sample(name, begin_ns + t, what)
        out += one.advance(begin_ns + t)
    return out


def ask(one: CalibrationSession, t_ns: int, **arguments: object) -> list[Output]:
    return one.request(Request(t_ns, "calibrate", "t", arguments))


def only(outputs: list[Output], kind: type[Any]) -> list[Any]:
    return [output for output in outputs if isinstance(output, kind)]


def posed(settings: CalibrationSettings) -> CalibrationSession:
    one = CalibrationSession(CHAIN, settings, mocap=True, calibration=None)
    ask(one, 0, phase="static")
    (job,) = only(play(one, trials()[0], 0), FitJob)
    one.finish_job(JobFinished(10 * SECOND, job.job, FitResult(), None))
    return one


def moved(settings: CalibrationSettings, **arguments: object) -> list[Output]:
    one = posed(settings)
    begun = ask(one, 10 * SECOND, phase="functional", **arguments)
    assert only(begun, Reply)[0].status == "accepted"
    return play(one, trials()[1], 10 * SECOND)


def length_s(outputs: list[Output]) -> float:
    return float((only(outputs, CalibrationProgress)[-1].t_ns - 10 * SECOND) / SECOND)


def test_phase_ends_when_every_joint_is_known() -> None:
    out = moved(QUICK)
    assert only(out, FitJob)
    assert QUICK.functional_min_s <= length_s(out) < 30.0
    last = only(out, CalibrationProgress)[-1]
    assert last.progress == 1.0
    assert "all joints known" in last.text
    assert not only(out, Notice)
    for joint in last.data["joints"].values():
        assert joint["met"] is True
        assert joint["noise_error_mm"] <= 10.0


def test_phase_lasts_at_least_its_minimum() -> None:
    eager = replace(QUICK, center_target_m=0.1)
    assert length_s(moved(eager)) >= QUICK.functional_min_s
    assert length_s(moved(replace(eager, functional_min_s=26.0))) >= 26.0


def test_longest_phase_ends_with_a_fit_and_names_missing_movements() -> None:
    out = moved(replace(QUICK, center_target_m=0.0001), seconds=8.0)
    assert only(out, FitJob)
    assert length_s(out) == pytest.approx(8.0, abs=0.3)
    notices = [notice.text for notice in only(out, Notice)]
    assert any(text.startswith("hip: ") and "swing the leg" in text for text in notices)
    assert all(notice.level == "warning" for notice in only(out, Notice))
    assert "hip: " in only(out, CalibrationStatus)[-1].text


def test_reported_error_decreases_and_payloads_are_valid_json() -> None:
    out = only(moved(QUICK), CalibrationProgress)
    errors = [p.data["joints"]["knee"]["noise_error_mm"] for p in out]
    known = [error for error in errors if error is not None]
    assert errors[0] is None
    assert known[-1] < known[0]
    for progress in out:
        json.loads(encode(dict(progress.data)))
        json.dumps(progress.data, allow_nan=False)


def test_same_movement_gives_the_same_progress() -> None:
    notices = [
        [(p.t_ns, p.data) for p in only(moved(QUICK), CalibrationProgress)] for _ in range(2)
    ]
    assert notices[0] == notices[1]


@pytest.mark.parametrize(
    ("phase", "lacks", "remedy"),
    [
        ("align", {"plate": None}, 'plate = "Plate"'),
        ("functional", {"markers": {"thigh": SETTINGS.markers["thigh"]}}, "markers.shank"),
    ],
)
def test_phase_without_markers_is_refused_at_once(
    phase: str, lacks: dict[str, Any], remedy: str
) -> None:
    one = posed(QUICK)
    other = CalibrationSession(CHAIN, replace(QUICK, **lacks), mocap=True, calibration=None)
    other.resume(one, same_rig=True)
    (reply,) = only(ask(other, 11 * SECOND, phase=phase), Reply)
    assert reply.status == "error"
    assert remedy in str(reply.error)


def test_rejected_result_gives_its_reason_in_the_status() -> None:
    one = posed(QUICK)
    ask(one, 10 * SECOND, phase="functional", seconds=2.0)
    (job,) = only(play(one, trials()[1], 10 * SECOND), FitJob)
    new = plain_calibration(CHAIN)
    result = FitResult(calibration=new, worse="knee: flexion error 5.0 deg, was 2.0")
    (status,) = only(
        one.finish_job(JobFinished(90 * SECOND, job.job, result, None)), CalibrationStatus
    )
    assert status.kept == "knee: flexion error 5.0 deg, was 2.0"
