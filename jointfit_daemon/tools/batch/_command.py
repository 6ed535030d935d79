"""Command `jointfit batch`: runs the same steps on every recording of a folder."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated

import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.text_output import check_choice, echo_json

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_daemon.tools.batch.recording_task import RecordingResult

_To = Annotated[str, typer.Option("--to", help="Formats of the step export, separated by commas.")]
_Jobs = Annotated[
    int | None,
    typer.Option("--jobs", min=1, help="Number of processes; default: one per processor."),
]


def batch(
    folder: Annotated[Path, typer.Argument(help="Folder with recordings, searched recursively.")],
    *,
    do: Annotated[
        str,
        typer.Option("--do", help="Steps, separated by commas: calibrate, replay, export, report."),
    ] = "report",
    to: _To = "csv",
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder; default: FOLDER/batch.")
    ] = None,
    jobs: _Jobs = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Run on this Dask cluster: tcp://HOST:8786.")
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the rows of the summary as JSON.")
    ] = False,
) -> None:
    """Process every recording of a folder, and summarize the results in a table.

    The command skips every recording that an earlier run has processed, unless the bytes of the
    recording, the steps, the formats or the version of this program changed. Exit codes: 0 all
    recordings are processed; 1 at least one recording failed, or its replay differs from the
    recorded run.
    """
    from jointfit_daemon.files.sessions import SESSION_FORMATS
    from jointfit_daemon.tools.batch.executors import run_in_pool, run_on_cluster
    from jointfit_daemon.tools.batch.find_recordings import find_recordings
    from jointfit_daemon.tools.batch.recording_task import STEPS
    from jointfit_daemon.tools.batch.summary import write_summary

    steps = _words("--do", do, STEPS)
    formats = _words("--to", to, [*SESSION_FORMATS]) if "export" in steps else ()
    if scheduler is not None and jobs is not None:
        raise ValueError(
            "--jobs and --scheduler: expected only one of them: a cluster has its own workers"
        )
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder with recordings")
    output = (folder / "batch" if out is None else out).resolve()
    tasks = find_recordings(folder.resolve(), output, steps, formats)
    if not tasks:
        raise ValueError(f"{folder}: found no recording (.mcap): name a folder with recordings")
    output.mkdir(parents=True, exist_ok=True)

    if scheduler is not None:
        running = run_on_cluster(tasks, scheduler)
    else:
        running = run_in_pool(tasks, jobs or os.cpu_count() or 1)
    results = _report_progress(running, len(tasks))
    written = write_summary(results, output)
    for path in written:
        typer.echo(f"wrote {path}", err=True)
    if json:
        rows = sorted(map(asdict, results), key=lambda row: row["recording"])
        echo_json({"recordings": rows, "files": [str(path) for path in written]})
    if any(result.status != "done" for result in results):
        raise typer.Exit(EXIT_FAILED)


def _report_progress(running: Iterator[RecordingResult], total: int) -> list[RecordingResult]:
    """Print a line for every processed recording; return the results."""
    results = []
    with show_activity("processing") as print_line:
        for number, result in enumerate(running, start=1):
            text = f": {result.error}" if result.error else ""
            print_line(f"[{number}/{total}] {result.recording}: {result.status}{text}")
            results.append(result)
    return results


def _words(option: str, text: str, choices: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a comma-separated list, in the order of `choices`.

    Raises
    ------
    ValueError
        The list is empty, or a word is not one of `choices`.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    for word in words or [""]:
        check_choice(option, word, choices)
    return tuple(choice for choice in choices if choice in words)
