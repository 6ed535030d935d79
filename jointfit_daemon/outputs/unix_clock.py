"""Conversion of CLOCK_MONOTONIC stamps to UNIX time.

NTP makes the kernel slew both clocks equally. Their offset therefore changes only if UNIX time is
set, or if the host was suspended, which stops CLOCK_MONOTONIC.
"""

from __future__ import annotations

import time
from typing import NamedTuple

from jointfit_daemon.units import NS_PER_S

STEP_NS = 50_000
"""Smallest change of the offset that counts as a step, in addition to the reading errors, ns."""
_READINGS = 5
"""Number of readings per measurement. The reading with the shortest duration is used."""


class _OffsetReading(NamedTuple):
    """One simultaneous reading of UNIX time and CLOCK_MONOTONIC."""

    width_ns: int
    """Duration of the reading, ns, which is twice its largest error."""
    offset_ns: int


class UnixClock:
    """Offset of UNIX time from CLOCK_MONOTONIC, measured at most once per second.

    Between steps the offset is constant, so intervals between stamps are preserved. After a step of
    UNIX time, the offset is corrected within one second.
    """

    def __init__(self) -> None:
        self._reading: _OffsetReading | None = None
        self._until_ns = -1

    def now_ns(self) -> int:
        """Return the current instant, CLOCK_MONOTONIC ns."""
        return time.monotonic_ns()

    def offset_ns(self) -> int:
        """Return UNIX time minus CLOCK_MONOTONIC, ns."""
        now_ns, before = time.monotonic_ns(), self._reading
        if before is not None and now_ns < self._until_ns:
            return before.offset_ns

        self._until_ns = now_ns + NS_PER_S
        readings = []
        for _ in range(_READINGS):
            before_ns, unix_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            offset_ns = unix_ns - (before_ns + after_ns) // 2
            readings.append(_OffsetReading(after_ns - before_ns, offset_ns))
        reading = min(readings)

        if before is not None:
            slack_ns = STEP_NS + (reading.width_ns + before.width_ns) // 2
            if abs(reading.offset_ns - before.offset_ns) <= slack_ns:
                return before.offset_ns

        self._reading = reading
        return reading.offset_ns
