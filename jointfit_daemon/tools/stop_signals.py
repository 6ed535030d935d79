"""Stop signals converted to a task cancellation, so that a command can clean up.

Invariant: the previous signal handlers are restored at the end of the ``with`` block.
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
"""Signals that stop a command. Ctrl-C, a service manager or `kill`, and a closed terminal send
these signals."""
_EXIT_BASE = 128
"""Offset of the exit code. By the convention of shells, a process that signal N stops has the code
128 + N."""


@dataclass(slots=True)
class StopRequest:
    """First stop signal that was received, if any."""

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

    A signal that the parent process ignores remains ignored, as with ``nohup``.
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
