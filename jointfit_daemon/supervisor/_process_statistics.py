"""How the process itself is: CPU, memory, delay of the loop. Law: cheap, and works in a sandbox.

``/proc/meminfo`` and friends are hidden under systemd's ProcSubset=pid; own pages are not.
"""

from __future__ import annotations

import os
import time
from collections import deque
from pathlib import Path

_PAGE = os.sysconf("SC_PAGE_SIZE")
_STATM = Path("/proc/self/statm")
_KEPT = 600
"""Loop delays kept for the percentile: a minute at ten a second."""


class ProcessStatistics:
    """Figures of this process since the last time they were read."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.monotonic(), time.process_time()
        self._delays_s: deque[float] = deque(maxlen=_KEPT)

    def late(self, seconds: float) -> None:
        """Note by how much a timer of the loop came late."""
        self._delays_s.append(seconds)

    def figures(self) -> dict[str, object]:
        """Return CPU share since the last call, resident memory, and the loop's delay."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        share = (cpu_s - self._cpu_s) / max(1e-9, wall_s - self._wall_s)
        self._wall_s, self._cpu_s = wall_s, cpu_s
        delays = sorted(self._delays_s)
        p99 = delays[int(0.99 * len(delays))] if delays else None
        return {
            "cpu_pct": round(100 * share, 1),
            "rss_bytes": _resident_bytes(),
            "loop_delay_p99_ms": None if p99 is None else round(1e3 * p99, 2),
        }


def _resident_bytes() -> int | None:
    try:
        return int(_STATM.read_text(encoding="ascii").split()[1]) * _PAGE
    except (OSError, ValueError, IndexError):
        return None
