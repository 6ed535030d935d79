"""Warnings and errors of the log, on ``bridge/log``. Law: five a second, the rest is counted."""

from __future__ import annotations

import asyncio
import logging
import threading
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.log._rate_limit import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Callable

RATE_HZ = 5.0


class MqttLogHandler(logging.Handler):
    """Hands warnings and errors to `tell`, on the loop's thread, at a bounded rate.

    Parameters
    ----------
    tell
        Called with level, logger, text and how many lines were suppressed since the last.
    """

    def __init__(self, tell: Callable[[str, str, str, int], None]) -> None:
        super().__init__(logging.WARNING)
        self._tell = tell
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._allowance = TokenBucket(RATE_HZ, RATE_HZ, self._loop.time())
        self._suppressed = 0

    def emit(self, record: logging.LogRecord) -> None:  # type: ignore[explicit-override]  # Python 3.12's
        """Take one record, from any thread."""
        line = record.levelname.lower(), record.name, record.getMessage()
        if threading.get_ident() == self._thread:
            self._take(*line)
        elif not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._take, *line)

    def _take(self, level: str, name: str, text: str) -> None:
        if not self._allowance.take(self._loop.time()):
            self._suppressed += 1
            return
        suppressed, self._suppressed = self._suppressed, 0
        self._tell(level, name, text, suppressed)
