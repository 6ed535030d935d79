"""Command `jointfit recover`: copies the readable messages of a damaged recording."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - typer reads it
from typing import Annotated

import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.output_files import check_output
from jointfit_daemon.tools.text_output import echo_json


def recover(
    file: Annotated[Path, typer.Argument(help="Recording: NAME.mcap or NAME.mcap.part.")],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Clean file to write; default: NAME.mcap for NAME.mcap.part, else NAME-clean.mcap."
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Copy the readable messages of a damaged recording to a clean file, and list what is missing.

    The commands of jointfit also read damaged recordings; other programs need a clean file. The
    damaged file is not changed. Exit codes: 0 copied; 1 the file cannot be read or written; 2 the
    file is not a recording.
    """
    from jointfit_daemon.outputs.recording import repair_recording

    check_output("--out", out, (".mcap",))
    if out is None:
        unfinished = file.name.endswith(".mcap.part")
        out = file.with_suffix("") if unfinished else file.with_name(f"{file.stem}-clean.mcap")
    if out.exists():
        raise ValueError(f"{out} exists: choose another name with --out, or delete it")

    with show_activity("copying"):
        result = repair_recording(file, out)
    if json:
        gaps = [
            {
                "first": gap.first_sequence,
                "count": gap.count,
                "s": gap.seconds,
                "reason": gap.reason,
            }
            for gap in result.gaps
        ]
        echo_json(
            {
                "file": str(result.path), "messages": result.messages, "duration_s": result.seconds,
                "gaps": gaps, "unreadable_bytes": result.unreadable_bytes, "closed": result.closed,
            }
        )  # fmt: skip
        return
    for gap in result.gaps:
        typer.echo(gap.text())
    if not result.closed:
        typer.echo("the recording was not closed: messages of its last second may be missing")
    if result.unreadable_bytes:
        typer.echo(f"{result.unreadable_bytes} bytes are damaged or incomplete")
    elif not result.gaps and result.closed:
        typer.echo("no message is missing")
    typer.echo(f"{result.path}: {result.messages} messages, {result.seconds:.3f} s")
