"""CPU share, memory and event loop delay of this process.

The module reads only ``/proc/self``, because the systemd option ProcSubset=pid hides the other
files in ``/proc``.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from pathlib import Path

from jointfit_daemon.outputs.payloads import ProcessHealth

_PAGE = os.sysconf("SC_PAGE_SIZE")
_STATM = Path("/proc/self/statm")
_DELAYS = 600
"""Number of stored loop delays for the percentile, equal to one minute at ten per second."""


class ProcessStatistics:
    """Measures CPU share, memory and event loop delay."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.monotonic(), time.process_time()
        self._delays_s: deque[float] = deque(maxlen=_DELAYS)

    def add_delay(self, seconds: float) -> None:
        """Add the delay of one timer of the event loop, s."""
        self._delays_s.append(seconds)

    def health(self) -> ProcessHealth:
        """Return CPU share since the last call, memory, and loop delay of the last minute."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        share = (cpu_s - self._cpu_s) / max(1e-9, wall_s - self._wall_s)
        self._wall_s, self._cpu_s = wall_s, cpu_s

        delays = sorted(self._delays_s)
        p99 = delays[int(0.99 * len(delays))] if delays else None

        rss_bytes = None
        with contextlib.suppress(OSError, ValueError, IndexError):
            rss_bytes = int(_STATM.read_text(encoding="ascii").split()[1]) * _PAGE
        delay_ms = None if p99 is None else round(1e3 * p99, 2)
        return ProcessHealth(round(100 * share, 1), rss_bytes, delay_ms)
