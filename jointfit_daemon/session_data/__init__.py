"""Recorded session as arrays, independent of file formats, for files, replay and reports.

Every series has its own times in seconds since the start of the session. CONVENTIONS.md defines
world and segment axes. The optical world and the world of the sensors differ by a rotation about
the vertical.
"""

from jointfit_daemon.session_data._resampling import (
    interpolate_orientations,
    interpolate_values,
    is_uniform,
    rows_on_axis,
    sample_rate_hz,
    uniform_times,
)
from jointfit_daemon.session_data._series import (
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionDataError,
    TimelineEvent,
)
from jointfit_daemon.session_data._session import SessionData

__all__ = [
    "JointSeries",
    "MarkerSeries",
    "SegmentSeries",
    "SensorSeries",
    "SessionData",
    "SessionDataError",
    "TimelineEvent",
    "interpolate_orientations",
    "interpolate_values",
    "is_uniform",
    "rows_on_axis",
    "sample_rate_hz",
    "uniform_times",
]
