"""The end that comes even if something hangs. Law: never needed, unless there is a bug."""

from __future__ import annotations

import faulthandler
import logging
import os
import threading

log = logging.getLogger(__name__)


def exit_within(seconds: float, code: int, why: str) -> None:
    """End the process with `code` after `seconds`, unless it ended before.

    A thread that looks up a name, or a driver that does not let go, cannot be interrupted. A
    thread of its own watches the time, for the loop itself may be what hangs.
    """

    def leave() -> None:
        log.error("%s did not end within %g s: leaving without it", why, seconds)
        faulthandler.dump_traceback()
        logging.shutdown()
        os._exit(code)

    last = threading.Timer(seconds, leave)
    last.daemon = True
    last.start()
