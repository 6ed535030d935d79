"""Frames from the reports of single bodies.

VRPN has no frames: every body has messages of its own, and a body that is not seen has none. The
reports of one frame have nearly equal times. A frame ends when every awaited body has reported,
when one reports again, or with a report half a period later. A body is awaited until it has not
reported for three periods, at least 100 ms; it is absent from every frame without its report.

Invariant: pure; the result depends only on the reports, not on their arrival. A body is at most
once in a frame.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_drivers.motion_capture import ColumnKey  # noqa: TC001 - mypyc evaluates fields
from jointfit_protocols.vrpn import TrackerPose  # noqa: TC001 - mypyc evaluates fields

_LEAST_AWAITED_US = 100_000
"""Shortest time for which a silent body is awaited, µs."""
_AWAITED_PERIODS = 3
_SAME_FRAME = 0.5
"""Largest difference of the times in one frame, periods."""
_FIRST_SPREAD_US = 2_000.0
"""Largest difference of the times in one frame before the period is known, µs."""
_LONGEST_US = 500_000
"""Longest time between two reports of one body that is a period, µs."""
_REORDERED_US = 100_000
"""Time by which a report may be older than the last one of its body if datagrams were reordered;
older ones show a step of the clock."""
_GAIN = 0.1
"""Gain of the mean time between two reports of a body."""


class ReportedFrame(NamedTuple):
    """Reports of one frame."""

    time_us: int
    """Time of the first report, wall clock of the server."""
    arrival_ns: int
    """Arrival of the first report."""
    reports: dict[ColumnKey, TrackerPose]


class FrameAssembler:
    """Groups the reports of one server."""

    def __init__(self) -> None:
        self._reports: dict[ColumnKey, TrackerPose] = {}
        self._time_us = self._arrival_ns = 0
        self._closed: ReportedFrame | None = None
        self._period_us: float | None = None
        self._mean_us: dict[ColumnKey, float] = {}
        self._last_us: dict[ColumnKey, int] = {}
        self._awaited: set[ColumnKey] = set()
        self.late = 0
        """Reports dropped because a later one of the body had arrived, or their frame had ended."""
        self.duplicates = 0
        """Reports dropped because the body had reported at the same time."""

    def forget(self) -> None:
        """Start again: another server, or another connection."""
        self._reports = {}
        self._closed = self._period_us = None
        self._mean_us.clear()
        self._last_us.clear()
        self._awaited.clear()

    def feed(self, key: ColumnKey, report: TrackerPose, arrival_ns: int) -> list[ReportedFrame]:
        """Return the frames that a report completes: at most two.

        Parameters
        ----------
        key : ColumnKey
            The body.
        report : TrackerPose
            Report of the body.
        arrival_ns : int
            Arrival of the report, ns.
        """
        time_us = report.time_us
        step_us = time_us - self._last_us.get(key, time_us - 1)
        if -_REORDERED_US < step_us <= 0:  # not newer than the last report of the body
            self.duplicates += step_us == 0
            self.late += step_us < 0
            return []

        out = []
        spread_us = _FIRST_SPREAD_US if self._period_us is None else _SAME_FRAME * self._period_us
        distance_us = abs(time_us - self._time_us)
        if self._reports and (key in self._reports or distance_us > spread_us):
            out.append(self._close())
        if not self._reports:
            # Its frame may have ended without it, because it was not awaited.
            closed = self._closed
            if (
                closed is not None
                and not out
                and key not in closed.reports
                and abs(time_us - closed.time_us) <= spread_us
            ):
                self.late += 1
                self._note(key, time_us)
                return []
            self._time_us, self._arrival_ns = time_us, arrival_ns

        self._note(key, time_us)
        self._reports[key] = report
        if self._period_us is not None and len(self._reports) == len(self._awaited):
            out.append(self._close())
        return out

    def flush(self) -> list[ReportedFrame]:
        """Return the frame in progress."""
        return [self._close()] if self._reports else []

    def _note(self, key: ColumnKey, time_us: int) -> None:
        """Measure the period, and await this body in the next frames."""
        step_us = time_us - self._last_us.get(key, time_us)
        if 0 < step_us <= _LONGEST_US:
            # A mean, because steps between delayed frames are too long and too short in turn.
            mean_us = self._mean_us.setdefault(key, float(step_us))
            self._mean_us[key] = mean_us + _GAIN * (step_us - mean_us)
            if self._period_us is None:
                self._period_us = float(step_us)
        self._last_us[key] = time_us
        self._awaited.add(key)

    def _close(self) -> ReportedFrame:
        """Return the frame in progress, and drop bodies that are silent for too long."""
        frame = ReportedFrame(self._time_us, self._arrival_ns, self._reports)
        self._closed, self._reports = frame, {}
        # A body that is always seen has the shortest mean.
        known = [mean for key, mean in self._mean_us.items() if key in self._awaited]
        self._period_us = min(known, default=self._period_us)
        missing = self._awaited - frame.reports.keys()
        if missing:
            limit_us = max(_LEAST_AWAITED_US, _AWAITED_PERIODS * (self._period_us or 0.0))
            for key in missing:
                if abs(frame.time_us - self._last_us[key]) > limit_us:
                    self._awaited.discard(key)
        return frame
