"""Reports on the tables that the commands write for OpenSim."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.files.orientations import WrittenTable


def table_notes(tables: Sequence[WrittenTable]) -> tuple[str, ...]:
    """Return the notes of all tables."""
    return tuple(note for table in tables for note in table.notes)


def report_written(tables: Sequence[WrittenTable]) -> None:
    """Print the written files on standard error; exit with 1 if a table has no complete frame."""
    for table in tables:
        if table.frames:
            typer.echo(f"wrote {table.path}", err=True)
        else:
            typer.echo(f"not written: {table.notes[0]}", err=True)
    if not all(table.frames for table in tables):
        raise typer.Exit(EXIT_FAILED)
