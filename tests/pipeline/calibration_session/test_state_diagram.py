"""The transition table of the calibration session, and its diagram in docs/calibration.md."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import pytest

from jointfit_daemon.pipeline.calibration_session._state_machine import (
    COLLECTING,
    RESTING,
    START,
    TRANSITIONS,
    SessionEvent,
)
from jointfit_daemon.pipeline.events import CalibrationPhase

PAGE = Path(__file__).parents[3] / "docs" / "calibration.md"
IDLE = "idle"


def diagram() -> str:
    """Return the transitions as text, one line each; all idle phases are shown as one phase."""
    rows = dict.fromkeys(
        (IDLE if phase in RESTING else str(phase), str(event), str(after))
        for (phase, event), after in TRANSITIONS.items()
    )
    widths = [max(len(row[i]) for row in rows) for i in range(2)]
    lines = [
        f"{phase:<{widths[0]}}  ── {event} {'─' * (widths[1] - len(event))}─►  {after}"
        for _, group in groupby(rows, key=lambda row: row[0])
        for phase, event, after in group
    ]
    return "\n".join([*lines, f"{IDLE}: {', '.join(RESTING)}"])


def test_documentation_contains_the_diagram_of_the_transition_table() -> None:
    expected = f"```\n{diagram()}\n```"
    assert expected in PAGE.read_text(encoding="utf-8"), f"put into {PAGE}:\n{expected}"


@pytest.mark.parametrize("phase", CalibrationPhase)
def test_every_phase_can_be_left_and_all_but_the_first_reached(phase: CalibrationPhase) -> None:
    assert any(before == phase for before, _ in TRANSITIONS)
    assert phase in {*TRANSITIONS.values(), CalibrationPhase.UNCALIBRATED}


def test_every_phase_at_rest_accepts_every_request() -> None:
    for phase in RESTING:
        assert {TRANSITIONS[phase, START[wanted]] for wanted in COLLECTING} == set(COLLECTING)


@pytest.mark.parametrize("phase", [*COLLECTING, CalibrationPhase.FITTING])
def test_every_running_phase_can_fail_and_accepts_no_request(phase: CalibrationPhase) -> None:
    assert TRANSITIONS[phase, SessionEvent.FAILED] == CalibrationPhase.ABORTED
    assert not any((phase, event) in TRANSITIONS for event in START.values())
