"""Command `jointfit report`: writes the page of a recorded session."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import Annotated

import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.output_files import check_output
from jointfit_daemon.tools.text_output import echo_json


def report(
    recording: Annotated[
        Path, typer.Argument(help="Recording (.mcap), or another file of a session.")
    ],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="Page to write; default: next to the recording.")
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the name of the page as JSON.")
    ] = False,
) -> None:
    """Write a session as one HTML page: angles, gait, range of motion, differences, faults."""
    from jointfit_daemon.tools.report.writing import report_name, write_report

    page = report_name(recording) if out is None else out
    check_output("--out", page, (".html",))
    with show_activity("computing"):
        write_report(recording, page)
    if json:
        echo_json({"file": str(page)})
    else:
        typer.echo(f"wrote {page}", err=True)
