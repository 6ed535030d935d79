"""Stop signals converted to a task cancellation, so that a command can clean up.

Invariant: the ``with`` block restores the signal handlers.
"""

from __future__ import annotations

import asyncio
import signal
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that Ctrl-C, a service manager or `kill`, and a closed terminal send."""
_EXIT_BASE = 128
"""Exit code of a process stopped by signal N is 128 + N, the convention of shells."""


@dataclass(slots=True)
class StopRequest:
    """First stop signal received, if any."""

    number: signal.Signals | None = None

    @property
    def exit_code(self) -> int:
        """Return the exit code of the stopped command."""
        return _EXIT_BASE + (self.number or signal.SIGINT)

    @property
    def name(self) -> str:
        """Return the name of the signal."""
        return (self.number or signal.SIGINT).name


@contextmanager
def cancel_on_signal() -> Iterator[StopRequest]:
    """Cancel the current task when a stop signal arrives.

    Signals that the parent process ignores remain ignored (``nohup``).
    """
    task, loop = asyncio.current_task(), asyncio.get_running_loop()
    request = StopRequest()

    def stop(number: signal.Signals) -> None:
        request.number = request.number or number
        if task is not None:
            task.cancel()

    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    caught = [number for number in STOP_SIGNALS if before[number] is not signal.SIG_IGN]
    for number in caught:
        loop.add_signal_handler(number, stop, number)
    try:
        yield request
    finally:
        for number in caught:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])
