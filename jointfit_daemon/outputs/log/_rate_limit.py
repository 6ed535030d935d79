"""What may be said in a second. Law: a flood of lines fills no disk, and its size is told.

systemd limits services, too, but at 10 000 lines in 30 s: a gateway that chatters at half of that
writes gigabytes a day and wears its memory card out.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TextIO

RATE_HZ, BURST = 5.0, 50.0


class TokenBucket:
    """A bucket that fills at `rate_hz` up to `burst`; whoever takes from it may speak.

    Parameters
    ----------
    rate_hz
        Lines a second, on average.
    burst
        Lines at once, after a quiet time.
    now_s
        Any clock's time that does not go back; full at the start.
    """

    def __init__(self, rate_hz: float, burst: float, now_s: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._left, self._at_s = burst, now_s

    def take(self, now_s: float) -> bool:
        """Return whether one more line may be said."""
        self._left = min(self._burst, self._left + self._rate_hz * (now_s - self._at_s))
        self._at_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True


class RateLimitedHandler(logging.StreamHandler["TextIO"]):
    """Writes lines at a bounded rate; errors always pass.

    Parameters
    ----------
    stream
        Where to.
    clock
        Tells the time, s.
    allowance
        How much may be said.
    """

    def __init__(
        self,
        stream: TextIO,
        clock: Callable[[], float] = time.monotonic,
        allowance: TokenBucket | None = None,
    ) -> None:
        super().__init__(stream)
        self._clock = clock
        self._allowance = allowance or TokenBucket(RATE_HZ, BURST, clock())
        self._left_out = 0

    def emit(self, record: logging.LogRecord) -> None:  # type: ignore[explicit-override]  # Python 3.12's
        """Write `record`, and how many before it were not written."""
        if not self._allowance.take(self._clock()) and record.levelno < logging.ERROR:
            self._left_out += 1
            return
        if self._left_out:
            count, self._left_out = self._left_out, 0
            text = (
                f"{count} line{'s' if count > 1 else ''} left out: more than {RATE_HZ:g} a second"
            )
            self.put(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))
        self.put(record)

    def put(self, record: logging.LogRecord) -> None:
        """Write one record, whatever was said before."""
        super().emit(record)
