"""Token bucket that limits the mean rate of log lines and requests, but permits short bursts."""

from __future__ import annotations


class TokenBucket:
    """A bucket that fills with `rate_hz` tokens per second up to a capacity of `burst`.

    Parameters
    ----------
    rate_hz
        Permitted mean rate, 1/s.
    burst
        Capacity of the bucket, which limits the number of tokens after a pause. The bucket is
        full at the start.
    now_s
        Current time of any monotonic clock, s.
    """

    def __init__(self, rate_hz: float, burst: float, now_s: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._left, self._at_s = burst, now_s

    def take(self, now_s: float) -> bool:
        """Take one token and return True; return False if the bucket is empty."""
        self._left = min(self._burst, self._left + self._rate_hz * (now_s - self._at_s))
        self._at_s = now_s

        if self._left < 1:
            return False
        self._left -= 1
        return True
