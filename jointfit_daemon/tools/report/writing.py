"""Writing of the report of a recording, for `jointfit report` and `jointfit batch`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.tools.export import load_data
from jointfit_daemon.tools.output_files import replace_file
from jointfit_daemon.tools.report.page import render_report

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.session_data import SessionData


def report_name(recording: Path) -> Path:
    """Return the default file name of the report of a recording."""
    return recording.with_name(f"{recording.name.split('.')[0]}-report.html")


def write_report(recording: Path, page: Path) -> SessionData:
    """Write the page of a recording, and return its session.

    Raises
    ------
    ValueError
        The errors of `load_data`.
    OSError
        The recording cannot be read, or the page cannot be written.
    """
    session = load_data(recording)
    write_page(session, page)
    return session


def write_page(session: SessionData, page: Path) -> None:
    """Write the page of a session; a complete new page replaces an existing page."""
    replace_file(page, render_report(session))
