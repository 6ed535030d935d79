"""`PhaseTracker` finds the end of a phase in MQTT messages; results and progress are printed."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
import typer

from jointfit_daemon.outputs.mqtt import NoAnswerError
from jointfit_daemon.tools.calibrate import (
    PhaseAbortedError,
    PhaseTracker,
    _command,
    _phase_tracker,
    movement_lines,
)
from jointfit_daemon.tools.calibrate._report import report
from jointfit_daemon.tools.command_group import EXIT_FAILED

if TYPE_CHECKING:
    from collections.abc import Mapping


def tracker_after(*phases: str) -> PhaseTracker:
    one = PhaseTracker(lambda *_: None)
    one.begin()
    for phase in phases:
        one.on_status({"phase": phase, "text": f"it is {phase}", "version": 1})
    return one


async def test_retained_status_of_an_earlier_phase_does_not_end_the_wait() -> None:
    one = tracker_after("calibrated")
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.05):
            await one.wait_for_end("functional")


@pytest.mark.parametrize(
    ("phase", "end"),
    [("align", "aligned"), ("static", "posed"), ("static", "calibrated"),
     ("functional", "calibrated"), ("functional", "uncalibrated")],
)  # fmt: skip
async def test_first_state_after_phase_and_fit_ends_the_wait(phase: str, end: str) -> None:
    ended = await tracker_after("aborted", phase, "fitting", end).wait_for_end(phase)
    assert ended["phase"] == end


async def test_aborted_phase_raises_its_reason() -> None:
    with pytest.raises(PhaseAbortedError, match="it is aborted"):
        await tracker_after("static", "aborted").wait_for_end("static")


async def test_failure_is_raised_in_the_waiting_task() -> None:
    one = tracker_after("static")
    asyncio.get_running_loop().call_later(0.01, one.fail, PhaseAbortedError("gone"))
    with pytest.raises(PhaseAbortedError, match="gone"):
        await one.wait_for_end("static")


async def test_wait_for_store_returns_the_version_or_times_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_phase_tracker, "STORING_S", 0.05)
    one = tracker_after("functional", "fitting", "calibrated")
    ended = await one.wait_for_end("functional")
    assert await one.wait_for_store(ended) is ended
    stored = {"phase": "calibrated", "text": "stored as version 2", "version": 2}
    asyncio.get_running_loop().call_later(0.01, one.on_status, stored)
    assert (await one.wait_for_store(ended))["version"] == 2


async def test_wait_for_store_ends_at_once_if_the_result_could_not_be_stored() -> None:
    one = tracker_after("functional", "fitting", "calibrated")
    ended = await one.wait_for_end("functional")
    failed = {"phase": "calibrated", "text": "in force but not stored: /state: Read-only"}
    asyncio.get_running_loop().call_later(0.01, one.on_status, failed)
    status = await one.wait_for_store(ended)
    assert status == failed
    with pytest.raises(typer.Exit) as stop:
        _command._print_status(status, json=False)
    assert stop.value.exit_code == EXIT_FAILED


def test_report_contains_errors_centers_and_missing_align_phase() -> None:
    lines = report(
        {
            "alignment": None,
            "holdout": {
                "method": "anchored",
                "segments_deg": {"thigh": {"anchored": 2.11, "mean": 4.06}},
                "flexion_deg": {"knee": {"anchored": None}},
            },
            "anatomy": {
                "joints": {
                    "hip": {"source": "markers", "sd_m": 0.011},
                    "knee": {"source": "markers", "sd_m": 0.024},
                },
                "centers": {
                    "hip": {"method": "sphere"},
                    "knee": {"method": "oriented", "axis_sd_deg": 0.46},
                },
                "lengths_m": {"thigh": 0.41, "shank": None},
                "length_sources": {"thigh": "configured", "shank": "unknown"},
            },
        }
    )
    assert lines == [
        "thigh: orientation error 2.1°; error of the sensor mean 4.1°",
        "knee: flexion error unknown",
        "hip: center from markers, sd 11 mm",
        "knee: center from markers by oriented, sd 24 mm, axis ± 0.5°",
        "thigh: 0.410 m long, from configured",
        "no align phase: sensor headings are estimated from the static pose",
    ]


def test_report_of_empty_quality_is_empty() -> None:
    assert report({}) == []


def test_movement_lines_contain_one_line_per_joint() -> None:
    hip = {"met": True, "source": "markers", "predicted_error_mm": 16.66, "noise_error_mm": 2.11,
           "arc_deg": 64.2}  # fmt: skip
    knee = {"met": False, "source": "sensors", "predicted_error_mm": None, "bends": 3}
    ankle = {"met": False, "source": "unknown", "bends": 1}
    assert movement_lines({"joints": {"hip": hip, "knee": knee, "ankle": ankle}}) == [
        # The random error is rounded up, as in the text of the daemon.
        "✔ hip: center ± 16.7 mm, random error 2.2 mm, 64° range",
        "… knee: center unknown, 3 bends, from sensors",
        "… ankle: center unknown, 1 bend",
    ]
    assert movement_lines({}) == []


def test_details_are_shown_after_their_progress() -> None:
    told: list[object] = []
    one = PhaseTracker(lambda *said: told.append(said), told.append)
    one.on_progress({"phase": "functional", "progress": 0.5, "text": "on", "data": {"joints": {}}})
    assert told == [("functional", 0.5, "on"), {"joints": {}}]


def test_reason_of_an_abort_is_left_to_the_error_message() -> None:
    told: list[object] = []
    one = PhaseTracker(lambda *said: told.append(said), told.append)
    one.on_progress({"phase": "aborted", "progress": None, "text": "C1 moves by 159 mm"})
    assert told == []


@pytest.mark.parametrize("terminal", [True, False])
def test_result_that_is_not_stored_is_printed_once(
    monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(isatty=lambda: terminal))
    one, text = tracker_after(), "in force but not stored: no space left"
    event = {"kind": "calibration", "level": "error", "id": "bench", "text": text}
    printed = [
        _command.handle_message(one, "calibration", {"phase": "calibrated", "text": text}),
        _command.handle_message(one, "bridge/event", event),
    ]
    assert sum(line is not None for line in printed) == 1


def test_state_directory_without_write_access_is_printed() -> None:
    text = "state directory cannot be written: no permission"
    event = {"kind": "state", "level": "error", "id": "bench", "text": text}
    assert _command.handle_message(tracker_after(), "bridge/event", event) == f"bench: {text}"


async def interrupted(phase: str, *states: Mapping[str, object]) -> object:
    """Return the status that ends `phase` if the daemon was offline before `states`."""
    one = tracker_after("calibrated", phase)
    waiting = asyncio.create_task(one.wait_for_end(phase))
    await asyncio.sleep(0)
    assert one.on_state("offline") == "the daemon is offline: waiting up to 60 s for it"
    assert one.on_state("offline") is None  # the state is reported only once
    for status in states:
        one.on_status(status)
    assert one.on_state("online") == "the daemon is online again"
    async with asyncio.timeout(5):
        return await waiting


async def test_phase_goes_on_after_the_daemon_was_offline_briefly() -> None:
    running = {"phase": "functional", "version": 1}  # the daemon sends its retained status again
    ended = {"phase": "calibrated", "version": None}
    assert await interrupted("functional", running, ended) is ended


async def test_phase_may_end_while_the_daemon_is_offline() -> None:
    rejected = {"phase": "calibrated", "version": 1, "kept": "worse than version 1"}
    assert await interrupted("functional", rejected) is rejected
    posed = {"phase": "posed", "version": None}
    assert await interrupted("static", posed) is posed


@pytest.mark.parametrize(
    "state", [{"phase": "uncalibrated"}, {"phase": "calibrated", "version": 1}]
)
async def test_restart_of_the_daemon_loses_the_phase(state: dict[str, object]) -> None:
    with pytest.raises(PhaseAbortedError, match="static was lost when the daemon was restarted"):
        await interrupted("static", state)


async def test_wait_for_an_offline_daemon_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_phase_tracker, "OFFLINE_S", 0.05)
    one = tracker_after("static")
    asyncio.get_running_loop().call_later(0.01, one.on_state, "offline")
    with pytest.raises(
        PhaseAbortedError, match=r"was offline for 0\.05 s: check that jointfitd runs"
    ):
        await one.wait_for_end("static")


async def test_state_of_the_daemon_between_phases_is_not_reported() -> None:
    one = PhaseTracker(lambda *_: None)
    assert [one.on_state(state) for state in ("online", "offline", "online")] == [None] * 3


class SilentDaemon:
    """Replacement for the MQTT client; no request receives an answer."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    async def request(self, _: str, arguments: Mapping[str, str], **__: float) -> dict[str, object]:
        self.asked.append(arguments["phase"])
        await asyncio.sleep(0.01)
        raise NoAnswerError("no daemon answers")


async def run_static(client: SilentDaemon, *later: str) -> Mapping[str, object]:
    one = PhaseTracker(lambda *_: None)
    one.on_status({"phase": "aborted", "text": "the phase of yesterday", "version": 1})
    running = asyncio.create_task(
        _command._run_phase(client, one, {"phase": "static"}, Path("rig.toml"))  # type: ignore[arg-type]
    )
    await asyncio.sleep(0)
    for phase in later:
        one.on_status({"phase": phase, "text": f"it is {phase}", "version": 1})
    return await running


async def test_status_of_the_requested_phase_replaces_a_lost_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_phase_tracker, "STORING_S", 0.01)
    client = SilentDaemon()
    ended = await run_static(client, "static", "posed")
    assert ended["phase"] == "posed"
    assert client.asked == ["static"], "the phase goes on"


async def test_request_without_answer_and_status_is_aborted() -> None:
    client = SilentDaemon()
    with pytest.raises(NoAnswerError):
        await run_static(client)
    assert client.asked == ["static", "abort"]


@pytest.mark.parametrize(
    ("phase", "text", "line"),
    [
        ("posed", "stored as version 3", "static: ended before the abort: stored as version 3"),
        ("aborted", "abort requested", "static: aborted"),
    ],
)
async def test_stop_after_the_end_of_the_phase_reports_its_final_status(
    capsys: pytest.CaptureFixture[str], phase: str, text: str, line: str
) -> None:
    class AnsweringDaemon:
        async def request(self, *_: object, **__: object) -> dict[str, object]:
            status = {"phase": phase, "text": "static pose recorded", "version": 2}
            one.on_status(status)
            later = status | {"text": text, "version": 3}
            asyncio.get_running_loop().call_later(0.01, one.on_status, later)
            return {"status": "ok", "data": {"phase": "calibrated"}}

    one = tracker_after("static")
    done = asyncio.create_task(AnsweringDaemon().request())
    await _command._abort_phase(AnsweringDaemon(), one, "static", done, Path("rig.toml"))  # type: ignore[arg-type]
    assert capsys.readouterr().err.splitlines() == [line]


def test_retained_status_of_the_last_phase_is_not_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(isatty=lambda: False))
    one = PhaseTracker(lambda *_: None)
    old = {"phase": "posed", "text": "the phase of yesterday"}
    assert _command.handle_message(one, "calibration", old) is None
    one.begin()
    assert _command.handle_message(one, "calibration", old) == "posed: the phase of yesterday"


def test_reason_of_an_abort_is_not_a_status_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason is printed once, in the error message of the command."""
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(isatty=lambda: False))
    one = PhaseTracker(lambda *_: None)
    one.begin()
    aborted = {"phase": "aborted", "text": "static: T1 and T2 look exchanged"}
    assert _command.handle_message(one, "calibration", aborted) is None
    assert one.status == aborted
