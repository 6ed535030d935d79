"""End of the process within a time limit, even if a thread or the event loop hangs."""

from __future__ import annotations

import faulthandler
import logging
import os
import threading

log = logging.getLogger(__name__)


def exit_within(seconds: float, code: int, activity: str) -> None:
    """End the process with `code` after `seconds`, unless it has ended by then.

    A thread that resolves a host name, or a driver that does not return, cannot be interrupted.
    The limit runs in a thread of its own, since the event loop may be the part that hangs.

    Parameters
    ----------
    seconds
        Time limit, s.
    code
        Exit code.
    activity
        Name of the activity with the time limit, for the log.
    """

    def exit_now() -> None:
        log.error("%s did not end within %g s: exiting", activity, seconds)
        faulthandler.dump_traceback()
        logging.shutdown()
        os._exit(code)

    timer = threading.Timer(seconds, exit_now)
    timer.daemon = True
    timer.start()
