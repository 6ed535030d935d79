"""Leading a calibration: what counts as an answer, what does not, and what is told at the end."""

from __future__ import annotations

import asyncio
import sys
from types import SimpleNamespace

import pytest

from jointfit_daemon.tools.calibrate import (
    CalibrationWatch,
    PhaseAborted,
    _command,
    _phase_tracker,
    movement_lines,
    report,
)


def watch(*phases: str) -> CalibrationWatch:
    one = CalibrationWatch(lambda *_: None)
    one.begin()
    for phase in phases:
        one.on_status({"phase": phase, "text": f"it is {phase}", "version": 1})
    return one


async def test_a_retained_status_of_earlier_is_not_the_answer() -> None:
    one = watch("calibrated")
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.05):
            await one.ended("functional")


@pytest.mark.parametrize(
    ("phase", "end"),
    [("align", "aligned"), ("static", "posed"), ("static", "calibrated"),
     ("functional", "calibrated"), ("functional", "uncalibrated")],
)  # fmt: skip
async def test_whatever_follows_the_phase_and_its_fit_ends_it(phase: str, end: str) -> None:
    ended = await watch("aborted", phase, "fitting", end).ended(phase)
    assert ended["phase"] == end


async def test_an_aborted_phase_is_told_with_its_reason() -> None:
    with pytest.raises(PhaseAborted, match="it is aborted"):
        await watch("static", "aborted").ended("static")


async def test_who_waits_is_told_that_the_daemon_is_gone() -> None:
    one = watch("static")
    asyncio.get_running_loop().call_later(0.01, one.lose, PhaseAborted("gone"))
    with pytest.raises(PhaseAborted, match="gone"):
        await one.ended("static")


async def test_the_version_of_the_store_is_waited_for_but_not_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_phase_tracker, "STORING_S", 0.05)
    one = watch("functional", "fitting", "calibrated")
    ended = await one.ended("functional")
    assert await one.stored(ended) is ended
    stored = {"phase": "calibrated", "text": "stored as version 2", "version": 2}
    asyncio.get_running_loop().call_later(0.01, one.on_status, stored)
    assert (await one.stored(ended))["version"] == 2


def test_the_report_names_errors_centers_and_a_missing_align_phase() -> None:
    lines = report(
        {
            "alignment": None,
            "holdout": {
                "method": "anchored",
                "segments_deg": {"thigh": {"anchored": 2.11, "mean": 4.06}},
                "flexion_deg": {"knee": {"anchored": None}},
            },
            "anatomy": {
                "joints": {"knee": {"source": "markers", "sd_m": 0.024}},
                "lengths_m": {"thigh": 0.41, "shank": None},
                "length_sources": {"thigh": "configured", "shank": "unknown"},
            },
        }
    )
    assert lines == [
        "thigh: orientation error 2.1°; the mean of the sensors has 4.1°",
        "knee: flexion error unknown",
        "knee: center by markers, sd 24 mm",
        "thigh: 0.410 m long, by configured",
        "no align phase: headings come from the static pose",
    ]


def test_nothing_known_is_nothing_told() -> None:
    assert report({}) == []


def test_a_movement_is_told_a_joint_a_line_and_what_is_unknown_is_said() -> None:
    hip = {"met": True, "source": "markers", "predicted_error_mm": 16.66, "noise_error_mm": 2.11,
           "arc_deg": 64.2}  # fmt: skip
    knee = {"met": False, "source": "sensors", "predicted_error_mm": None, "bends": 3}
    assert movement_lines({"joints": {"hip": hip, "knee": knee}}) == [
        "✔ hip: center ± 16.7 mm with skin, 2.1 mm by noise, 64° seen",
        "… knee: center unknown, bent 3×, by sensors",
    ]
    assert movement_lines({}) == []


def test_figures_follow_the_progress_they_came_with() -> None:
    told: list[object] = []
    one = CalibrationWatch(lambda *said: told.append(said), told.append)
    one.on_progress({"phase": "functional", "progress": 0.5, "text": "on", "data": {"joints": {}}})
    assert told == [("functional", 0.5, "on"), {"joints": {}}]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_result_that_is_not_stored_is_printed_once(
    monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(isatty=lambda: terminal))
    one, text = watch(), "in force but not stored: no space left"
    event = {"kind": "calibration", "level": "error", "id": "bench", "text": text}
    printed = [
        _command._heard(one, "calibration", {"phase": "calibrated", "text": text}),
        _command._heard(one, "bridge/event", event),
    ]
    assert sum(line is not None for line in printed) == 1
