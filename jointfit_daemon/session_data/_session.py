"""Session with all its series, its start and its events."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.session_data._series import SessionDataError, check_unique

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.session_data._series import (
        FrameSeries,
        JointSeries,
        MarkerSeries,
        SegmentSeries,
        SensorSeries,
        TimelineEvent,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SessionData:
    """A session as arrays.

    Invariant: sensors, segments and joints have unique names within their group.
    """

    name: str
    start_unix_ns: int | None = None
    """UNIX time at ``t_s`` = 0, ns. It is None if unknown, as in most motion-capture files."""
    sensors: tuple[SensorSeries, ...] = ()
    markers: MarkerSeries | None = None
    segments: tuple[SegmentSeries, ...] = ()
    """Orientations of segments, computed from the sensors."""
    joints: tuple[JointSeries, ...] = ()
    """Angles and positions of joints, computed from the sensors."""
    optical_segments: tuple[SegmentSeries, ...] = ()
    """Reference orientations of segments, computed from the markers."""
    optical_joints: tuple[JointSeries, ...] = ()
    """Reference angles and positions of joints, computed from the markers."""
    events: tuple[TimelineEvent, ...] = ()
    """Events in the order of their instants."""
    description: Mapping[str, str] = field(default_factory=dict)
    """Origin of the data: rig, software, calibration and file."""
    frames: FrameSeries | None = None
    """Mode and flags of the frames from which `segments` and `joints` were taken."""

    def __post_init__(self) -> None:
        check_unique("sensors", tuple(sensor.id for sensor in self.sensors))
        for group in ("segments", "joints", "optical_segments", "optical_joints"):
            check_unique(group, tuple(series.name for series in getattr(self, group)))

        times = [event.t_s for event in self.events]
        if not np.isfinite(times).all() or sorted(times) != times:
            raise SessionDataError("events: instants are not in order: sort the events by time")

    def time_axes(self) -> Iterator[Array]:
        """Yield the times of every series, s, shape (n,)."""
        for group in (
            self.sensors,
            self.segments,
            self.joints,
            self.optical_segments,
            self.optical_joints,
        ):
            yield from (series.t_s for series in group)
        if self.markers is not None:
            yield self.markers.t_s
        if self.frames is not None:
            yield self.frames.t_s

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row of all series, s; 0 without rows."""
        filled = [t_s for t_s in self.time_axes() if len(t_s)]
        if not filled:
            return 0.0
        return float(max(t_s[-1] for t_s in filled) - min(t_s[0] for t_s in filled))
