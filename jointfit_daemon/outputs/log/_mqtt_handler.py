"""Log handler that publishes warnings and errors on ``bridge/log``, at most five per second."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.token_bucket import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Callable

RATE_HZ = 5.0
"""Permitted rate on ``bridge/log``, messages per second, and permitted number of messages without
waiting.
"""


class MqttLogHandler(logging.Handler):
    """Passes warnings and errors to `publish` in the thread of the event loop.

    Parameters
    ----------
    publish
        Function that is called with level, logger, text, and number of suppressed lines since the
        last call.
    """

    def __init__(self, publish: Callable[[str, str, str, int], None]) -> None:
        super().__init__(logging.WARNING)
        self._publish = publish
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._bucket = TokenBucket(RATE_HZ, RATE_HZ, time.monotonic())
        self._suppressed = 0

    def emit(self, record: logging.LogRecord) -> None:  # type: ignore[explicit-override]  # Python 3.12's
        """Accept one record from any thread."""
        # The limit applies before records reach the event loop. Otherwise a library that logs
        # without pause in another thread would fill the loop's queue and delay all other work.
        if not self._bucket.take(time.monotonic()):
            self._suppressed += 1
            return
        suppressed, self._suppressed = self._suppressed, 0
        line = record.levelname.lower(), record.name, record.getMessage(), suppressed
        if threading.get_ident() == self._thread:
            self._publish(*line)
        elif not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._publish, *line)
