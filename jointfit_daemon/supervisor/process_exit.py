"""End of the process within a time limit, even if a thread or the event loop hangs."""

from __future__ import annotations

import faulthandler
import logging
import os
import threading
import time
from queue import SimpleQueue

log = logging.getLogger(__name__)

_REPORT_S = 0.15
"""Longest time for the log line and the tracebacks before a forced end, s."""


class ExitLimit:
    """Ends the process with an exit code if it still runs `seconds` after `start`.

    Some work cannot be interrupted: a thread that resolves a host name, or a driver that does not
    return. The time limit has its own thread, because the event loop may hang. This thread is
    started when the object is created, because no thread can be started safely in a signal handler.

    Parameters
    ----------
    seconds
        Time limit, s.
    code
        Exit code.
    activity
        Description of the activity with the time limit, for the log.
    """

    def __init__(self, seconds: float, code: int, activity: str) -> None:
        self._seconds, self._code, self._activity = seconds, code, activity
        self._started: SimpleQueue[bool] = SimpleQueue()
        threading.Thread(target=self._run, name=f"limit of {activity}", daemon=True).start()

    def start(self) -> None:
        """Start the time limit.

        A signal handler may call this method. A repeated call has no effect.
        """
        self._started.put(True)

    def cancel(self) -> None:
        """End the thread of the time limit, unless the time limit is running."""
        self._started.put(False)

    def _run(self) -> None:
        if not self._started.get():
            return
        time.sleep(self._seconds)
        # If standard error is a pipe that no process reads, a write blocks without limit. The
        # report is therefore written in a separate thread.
        report = threading.Thread(target=self._report, daemon=True)
        report.start()
        report.join(_REPORT_S)
        os._exit(self._code)

    def _report(self) -> None:
        log.error("%s did not end within %g s: exiting", self._activity, self._seconds)
        faulthandler.dump_traceback()
        logging.shutdown()
