"""`echo_wrapped` wraps long lines on a terminal only."""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING

from jointfit_daemon.tools.text_output import echo_wrapped

if TYPE_CHECKING:
    import pytest


TEXT = "first\n  imu[S1].port = 'later': not filled in yet: connect the sensor\n"


def test_long_lines_break_at_blanks_on_a_terminal_below_their_text(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    shown = io.StringIO()
    monkeypatch.setattr(shown, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stdout", shown)
    echo_wrapped(TEXT)
    assert shown.getvalue().split("\n")[:3] == [
        "first",
        "  imu[S1].port = 'later': not filled in",
        "  yet: connect the sensor",
    ]


def test_other_outputs_get_the_lines_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    echo_wrapped(TEXT)
    assert capsys.readouterr().out == f"{TEXT}\n"
