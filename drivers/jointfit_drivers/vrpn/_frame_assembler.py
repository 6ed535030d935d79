"""Assembly of frames from the reports of single bodies.

VRPN has no frames: every body has its own messages, and a body that is not visible has none. The
reports of one frame have nearly equal times. A frame ends in three cases: every expected body has
reported, a body reports again, or the time of a report differs from the time of the first report by
more than half a period. A body that stops reporting is expected for three more periods, and for at
least 100 ms. In a frame without its report, the body is missing.

Invariant: the module is pure. The result depends only on the reports, not on their arrival. A frame
contains each body at most once.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_drivers.motion_capture import ColumnKey  # noqa: TC001 - mypyc evaluates fields
from jointfit_protocols.vrpn import TrackerPose  # noqa: TC001 - mypyc evaluates fields

_LEAST_AWAITED_US = 100_000
"""Shortest time for which a body without reports is still expected, µs."""
_AWAITED_PERIODS = 3
_SAME_FRAME = 0.5
"""Largest difference between the times in one frame, in periods."""
_FIRST_SPREAD_US = 2_000.0
"""Largest difference between the times in one frame while the period is unknown, µs."""
_LONGEST_US = 500_000
"""Longest time between two reports of one body that counts as a period, µs."""
_REORDERED_US = 100_000
"""Largest time by which a report may be older than the body's last report because of reordered
datagrams, µs. An older report shows a step of the clock."""
_GAIN = 0.1
"""Weight of a new interval in the mean time between two reports of a body."""


class ReportedFrame(NamedTuple):
    """All reports of one frame."""

    time_us: int
    """Time of the first report on the server's clock, µs."""
    arrival_ns: int
    """Arrival of the first report, ns."""
    reports: dict[ColumnKey, TrackerPose]


class FrameAssembler:
    """Groups the reports of one server into frames."""

    def __init__(self) -> None:
        self._reports: dict[ColumnKey, TrackerPose] = {}
        self._time_us = self._arrival_ns = 0
        self._closed: ReportedFrame | None = None
        self._period_us: float | None = None
        self._mean_us: dict[ColumnKey, float] = {}
        self._last_us: dict[ColumnKey, int] = {}
        self._awaited: set[ColumnKey] = set()
        self.late = 0
        """Number of reports dropped because a later report of the body had arrived, or their frame
        had ended."""
        self.duplicates = 0
        """Number of reports dropped because the body had already reported at the same time."""

    def forget(self) -> None:
        """Discard the state, because the server or the connection has changed."""
        self._reports = {}
        self._closed = self._period_us = None
        self._mean_us.clear()
        self._last_us.clear()
        self._awaited.clear()

    def feed(self, key: ColumnKey, report: TrackerPose, arrival_ns: int) -> list[ReportedFrame]:
        """Return the frames that a report completes, at most two.

        Parameters
        ----------
        key : ColumnKey
            Key of the body.
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
            # The frame of this report may have ended earlier, because the body was not expected.
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
        """Return the unfinished frame; empty if there is none."""
        return [self._close()] if self._reports else []

    def _note(self, key: ColumnKey, time_us: int) -> None:
        """Measure the period, and expect this body in the next frames."""
        step_us = time_us - self._last_us.get(key, time_us)
        if 0 < step_us <= _LONGEST_US:
            # A mean is used, because the steps between delayed frames are alternately too long and
            # too short.
            mean_us = self._mean_us.setdefault(key, float(step_us))
            self._mean_us[key] = mean_us + _GAIN * (step_us - mean_us)
            if self._period_us is None:
                self._period_us = float(step_us)
        self._last_us[key] = time_us
        self._awaited.add(key)

    def _close(self) -> ReportedFrame:
        """Return the unfinished frame, and remove bodies without reports for too long."""
        frame = ReportedFrame(self._time_us, self._arrival_ns, self._reports)
        self._closed, self._reports = frame, {}
        # The body with the shortest mean interval is the one that is always visible.
        known = [mean for key, mean in self._mean_us.items() if key in self._awaited]
        self._period_us = min(known, default=self._period_us)
        missing = self._awaited - frame.reports.keys()
        if missing:
            limit_us = max(_LEAST_AWAITED_US, _AWAITED_PERIODS * (self._period_us or 0.0))
            for key in missing:
                if abs(frame.time_us - self._last_us[key]) > limit_us:
                    self._awaited.discard(key)
        return frame
