"""A moving bar on the terminal during a computation whose remaining time is unknown."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@contextmanager
def show_activity(label: str) -> Iterator[Callable[[str], None]]:
    """Show a moving bar and the elapsed time if standard error is a terminal.

    The context manager yields a function that prints a line on standard error, above the bar.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    disable = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=disable) as bar:
        bar.add_task(label, total=None)
        yield partial(console.print, markup=False, highlight=False, soft_wrap=True)
