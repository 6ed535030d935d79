"""All results of a session that the page of the report shows, computed once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.session_analysis import (
    angle_difference,
    find_gait_cycles,
    motion_range,
    series_quality,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.session_analysis import (
        AngleDifference,
        GaitCycles,
        MotionRange,
        SeriesQuality,
    )
    from jointfit_daemon.session_data import JointSeries, SessionData, TimelineEvent

SHANK_WORDS = ("shank", "tibia", "lower_leg")
"""Substrings in the names of segments whose rotation defines gait cycles."""
FAULT_LEVELS = ("warning", "error")
"""Levels of events that count as faults."""
VALUE_KINDS = ("clock", "latency", "source", "calibration")
"""Kinds of events whose values have their own sections."""


@dataclass(frozen=True, slots=True, eq=False)
class SessionResults:
    """A session and all results computed from it."""

    session: SessionData
    start_s: float
    end_s: float
    sources: Mapping[str, SeriesQuality]
    """Completeness of the data of every sensor, by id. The id of the cameras is ``cameras``."""
    ranges: tuple[MotionRange, ...]
    differences: tuple[AngleDifference, ...]
    gait: Mapping[str, GaitCycles]
    """Gait cycles by side: ``right``, ``left``, or an empty text for a limb without sides."""

    @property
    def angles(self) -> list[tuple[JointSeries, str]]:
        """Pairs of joint and angle name, for the angles that are known at some time."""
        return [
            (joint, angle)
            for joint in self.session.joints
            for angle, values in joint.angles.items()
            if np.isfinite(values).any()
        ]

    def optical_joint(self, name: str) -> JointSeries | None:
        """Return the angles of a joint as measured by the cameras; None without such angles."""
        return next((j for j in self.session.optical_joints if j.name == name), None)

    def values(self, kind: str) -> dict[str, Mapping[str, Any]]:
        """Return the data of the last event of `kind` for each event id."""
        return {event.id: event.data for event in self.session.events if event.kind == kind}

    @property
    def faults(self) -> int:
        """Number of events that are faults."""
        return sum(map(is_fault, self.session.events))


def analyze_session(session: SessionData) -> SessionResults:
    """Return all results of a session."""
    axes = [t_s for t_s in session.time_axes() if len(t_s)]
    sources = {
        series.id: series_quality(series.t_s, np.isfinite(series.orientation[:, 0]))
        for series in session.sensors
    }
    if session.markers is not None:
        seen = np.isfinite(session.markers.positions[:, :, 0]).sum(axis=1) > 0
        sources["cameras"] = series_quality(session.markers.t_s, seen)

    optical = {joint.name: joint for joint in session.optical_joints}
    ranges = (motion_range(j, angle) for j in session.joints for angle in j.angles)
    differences = (
        angle_difference(joint, optical[joint.name], angle)
        for joint in session.joints
        if joint.name in optical
        for angle in joint.angles
        if angle in optical[joint.name].angles
    )
    return SessionResults(
        session=session,
        start_s=min((float(t_s[0]) for t_s in axes), default=0.0),
        end_s=max((float(t_s[-1]) for t_s in axes), default=0.0),
        sources=sources,
        ranges=tuple(found for found in ranges if found is not None),
        differences=tuple(found for found in differences if found is not None),
        gait={
            side_of(series.name): find_gait_cycles(series)
            for series in session.segments
            if any(word in series.name.lower() for word in SHANK_WORDS)
        },
    )


def is_fault(event: TimelineEvent) -> bool:
    """Return whether an event reports a fault: it is a warning, an error or a gap in the data."""
    return event.data.get("level") in FAULT_LEVELS or event.kind == "gap"


def side_of(name: str) -> str:
    """Return the side in the name of a segment or joint: ``right``, ``left`` or an empty text."""
    words = name.lower().replace("-", "_").split("_")
    for side in ("right", "left"):
        if side in words or words[-1] == side[0] or words[0] == side[0]:
            return side
    return ""
