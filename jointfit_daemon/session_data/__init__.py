"""Recorded session as arrays, independent of any file format.

Every series has its own times in seconds since the start of the session. CONVENTIONS.md defines the
axes of the world and of the segments. The optical world and the world of the sensors differ by a
rotation about the vertical.
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
    FrameSeries,
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionDataError,
    TimelineEvent,
)
from jointfit_daemon.session_data._session import SessionData

__all__ = [
    "FrameSeries",
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
