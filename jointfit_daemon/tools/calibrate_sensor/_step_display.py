"""Display of the calibration steps, as a progress bar on a terminal and as lines elsewhere."""

from __future__ import annotations

import sys
from time import monotonic
from typing import TYPE_CHECKING, Self

import typer

from jointfit_daemon.name_lists import list_names

if TYPE_CHECKING:
    from jointfit_daemon.calibration.inertial_sensor import StepProgress

_EVERY_S = 5.0
"""Shortest time between two lines, s. The line of a complete step is printed at once."""


class StepDisplay:
    """Shows instructions and progress.

    Parameters
    ----------
    err : bool
        Whether to write to standard error.
    """

    def __init__(self, *, err: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

        self._err = err
        self._console = Console(stderr=err)
        columns = (BarColumn(20), TaskProgressColumn(), TextColumn("{task.description}"))
        self._bar = Progress(*columns, console=self._console, transient=True)
        self._task = self._bar.add_task("", total=1.0)
        self._terminal = (sys.stderr if err else sys.stdout).isatty()
        self._last, self._last_s = "", 0.0

    def __enter__(self) -> Self:
        if self._terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, instruction: str) -> None:
        """Show the instruction of the next step."""
        self._last, self._last_s = "", monotonic()
        if self._terminal:
            self._bar.update(self._task, completed=0.0, description="")
            self._console.print(instruction, markup=False, highlight=False)
        else:
            typer.echo(instruction, err=self._err)

    def show(self, progress: StepProgress) -> None:
        """Show the progress of the current step."""
        missing = f"missing: {list_names(progress.missing)}" if progress.missing else "complete"
        text = "; ".join(filter(None, (progress.note, missing)))
        if self._terminal:
            self._bar.update(self._task, completed=progress.share, description=text)
            return
        now_s = monotonic()
        if text != self._last and (now_s - self._last_s >= _EVERY_S or text == "complete"):
            typer.echo(f"  {100 * progress.share:3.0f} %  {text}", err=self._err)
            self._last, self._last_s = text, now_s
