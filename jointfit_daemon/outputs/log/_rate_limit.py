"""Log handler with a limited rate.

Invariant: errors are always written, and the number of omitted lines is logged. systemd permits a
service 10 000 lines in 30 s. Even half of that rate would write gigabytes per day to a memory card.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.token_bucket import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TextIO

RATE_HZ = 5.0
"""Permitted mean rate, lines per second. It is sufficient for every state change of a rig."""
BURST = 50.0
"""Permitted number of lines without waiting. A start or a reload logs about twenty lines."""


class RateLimitedHandler(logging.StreamHandler["TextIO"]):
    """Writes log lines to a stream at a limited rate. Errors are not limited.

    Parameters
    ----------
    stream
        Destination.
    clock
        Function that returns monotonic time, s.
    bucket
        Rate limit. The default permits `RATE_HZ` and `BURST`.
    """

    def __init__(
        self,
        stream: TextIO,
        clock: Callable[[], float] = time.monotonic,
        bucket: TokenBucket | None = None,
    ) -> None:
        super().__init__(stream)
        self._clock = clock
        self._bucket = bucket or TokenBucket(RATE_HZ, BURST, clock())
        self._omitted = 0

    def emit(self, record: logging.LogRecord) -> None:  # type: ignore[explicit-override]  # Python 3.12's
        """Write `record` after a line that states how many lines were omitted before it."""
        if not self._bucket.take(self._clock()) and record.levelno < logging.ERROR:
            self._omitted += 1
            return

        if self._omitted:
            count, self._omitted = self._omitted, 0
            text = (
                f"{count} line{'s' if count > 1 else ''} omitted: "
                f"more than {RATE_HZ:g} lines per second"
            )
            self.put(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))
        self.put(record)

    def put(self, record: logging.LogRecord) -> None:
        """Write one record without limiting the rate."""
        super().emit(record)
