"""A functional phase with marker refinement: status and notices at its end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from jointfit_daemon.calibration import FitResult, FunctionalJob
from jointfit_daemon.calibration._quality import quality_table
from jointfit_daemon.calibration.phases import fit_static, run_job
from jointfit_daemon.pipeline.calibration_session import CalibrationSession
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStatus,
    FitJob,
    JobFinished,
    Notice,
    Output,
    Request,
)
from tests.calibration.synthetic_limb import (
    CHAIN,
    SETTINGS,
    Imperfections,
    Subject,
    static_and_functional,
)

S = 1_000_000_000
SUBJECT = Subject(5, flaws=Imperfections(skin_m=0.002))
REFINING = replace(SETTINGS, method="mean", static_s=3.0, functional_min_s=0.0)


def only(outputs: list[Output], kind: type[Any]) -> list[Any]:
    return [output for output in outputs if isinstance(output, kind)]


def asked(one: CalibrationSession, t_ns: int, phase: str) -> FitJob:
    """Request a phase and let its time pass; return the job, whose trial the caller replaces."""
    one.request(Request(t_ns, "calibrate", "t", {"phase": phase, "seconds": 4.0}))
    out: list[Output] = []
    for k in range(600):
        now_ns = t_ns + k * S // 50
        for sensor in ("S1", "S2", "S3", "S4"):
            out += one.add_sample(sensor, now_ns, (1.0, 0.0, 0.0, 0.0))
        out += one.advance(now_ns)
    (job,) = only(out, FitJob)
    assert isinstance(job, FitJob)
    return job


@pytest.mark.timeout(90)
def test_status_contains_the_quality_of_refined_markers() -> None:
    static, functional, _ = static_and_functional(SUBJECT, 20.0)
    one = CalibrationSession(CHAIN, REFINING, mocap=True, calibration=None)
    job = asked(one, 0, "static")
    pose = fit_static(static, REFINING, CHAIN)
    one.finish_job(JobFinished(30 * S, job.job, FitResult(quality_table(pose.quality)), None))
    one._static = static  # the recording of this test has no markers
    job = asked(one, 40 * S, "functional")
    assert isinstance(job.work, FunctionalJob)
    result = run_job(replace(job.work, static=static, functional=functional))
    out = one.finish_job(JobFinished(90 * S, job.job, result, None))
    (status,) = only(out, CalibrationStatus)
    assert status.phase == "calibrated"
    parts = status.quality["markers"]["parts"]
    assert set(parts) == {"pelvis", "thigh", "shank", "foot"}
    assert all(part["before_m"] > 0.0 for part in parts.values())
    (ready,) = only(out, CalibrationReady)
    assert ready.calibration.quality["markers"]["parts"] == parts
    assert not [n for n in only(out, Notice) if "not refined" in n.text]
