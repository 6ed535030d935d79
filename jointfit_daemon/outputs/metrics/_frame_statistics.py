"""Two statistics that are not health counters: latency of frames, and date of the calibration.

A frame costs one search in a table of twelve limits, and no allocation of memory.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from datetime import datetime
from typing import TYPE_CHECKING

from jointfit_daemon.model import LimbState
from jointfit_daemon.pipeline.events import CalibrationReady, CalibrationSelected, Configured

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event, Output

LATENCY_LIMITS_S = (0.001, 0.0025, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1, 0.25, 0.5, 1.0)
"""Upper limits of the histogram's buckets, s; the last bucket is open."""
_LIMITS_NS = [round(limit * 1e9) for limit in LATENCY_LIMITS_S]


class FrameStatistics:
    """Latency histogram and date of the current calibration; a `Sink` of the core.

    Latency is the time from the arrival of the sample that completed a frame to the delivery of
    the frame to the outputs.
    """

    def __init__(self) -> None:
        self.counts = [0] * (len(_LIMITS_NS) + 1)
        """Number of frames in each bucket, not cumulative."""
        self.sum_ns = 0
        self.calibrated_s: float | None = None
        """UNIX time at which the current calibration was stored, s; None if unknown."""

    def event(self, event: Event) -> None:
        """Store the date of a calibration that was loaded."""
        if type(event) is Configured or type(event) is CalibrationSelected:
            found = event.calibration
            self._note_date("" if found is None else found.created_utc)

    def output(self, output: Output) -> None:
        """Count the latency of a frame, or store the date of a new calibration."""
        if type(output) is LimbState:
            latency_ns = time.monotonic_ns() - output.completed_ns
            self.counts[bisect_left(_LIMITS_NS, latency_ns)] += 1
            self.sum_ns += latency_ns
        elif type(output) is CalibrationReady:
            if output.keep_date:
                self._note_date(output.calibration.created_utc)
            else:
                self.calibrated_s = time.time_ns() * 1e-9

    def _note_date(self, created_utc: str) -> None:
        try:
            self.calibrated_s = datetime.fromisoformat(created_utc).timestamp()
        except ValueError:
            self.calibrated_s = None
