"""State of a rig, computed from the messages on the topics below its base topic.

Invariants: the module uses no clock, I/O or terminal. Memory is bounded for any sequence of
messages.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from jointfit_daemon.outputs.payload_models import (
    CalibrationState,
    EventMessage,
    Health,
    Info,
    OpticalPose,
    Pose,
    Progress,
    State,
)
from jointfit_daemon.tools.monitor._decoding import UnreadablePayloadError, decode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic import BaseModel

TOPICS = (
    "bridge/state", "bridge/info", "bridge/health", "bridge/event", "calibration",
    "calibration/progress", "device/+/availability", "pose/ui", "optical/pose",
)  # fmt: skip
"""Topics below the base topic that the monitor reads."""
SHOWN_S = 20.0
"""Longest time range of the curve, s."""
_MOST_SAMPLES = 1000
"""Number of stored points of a curve. It suffices for 20 s of `pose/ui` at 30 Hz, or of
`optical/pose` at 50 Hz."""
_MOST_EVENTS = 300
_MOST_DEVICES = 200
"""Maximum number of stored devices, and of stored event ids. A rig has fewer than 50 devices."""
AngleChoice = tuple[str, str]
"""Name of a joint, and payload key of an angle such as ``flexion_deg``."""


@dataclass(frozen=True, slots=True)
class AngleSample:
    """Angles of all joints at one instant."""

    t_us: int
    angles: Mapping[AngleChoice, float | None]


@dataclass(frozen=True, slots=True)
class Moment:
    """Current time of the monotonic clock and of the UNIX clock of this machine."""

    monotonic_s: float
    unix_us: float


@dataclass(slots=True)
class RigView:
    """Newest messages of a rig, and the curves of the last seconds."""

    bridge: Literal["unknown", "online", "offline"] = "unknown"
    info: Info | None = None
    health: Health | None = None
    calibration: CalibrationState | None = None
    progress: Progress | None = None
    pose: Pose | None = None
    pose_s: float | None = None
    """Time of receipt of `pose`, s of the monotonic clock."""
    optical: OpticalPose | None = None
    optical_s: float | None = None
    availability: dict[str, str] = field(default_factory=dict)
    last_events: dict[str, EventMessage] = field(default_factory=dict)
    """Newest event for each event id."""
    events: deque[EventMessage] = field(default_factory=lambda: deque(maxlen=_MOST_EVENTS))
    """Events, the newest first."""
    poses: deque[AngleSample] = field(default_factory=lambda: deque(maxlen=_MOST_SAMPLES))
    opticals: deque[AngleSample] = field(default_factory=lambda: deque(maxlen=_MOST_SAMPLES))
    faults: dict[str, str] = field(default_factory=dict)
    """Reason why the last message of a topic could not be decoded."""
    reach_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Largest horizontal distance of a joint from the first joint, and the smallest and largest
    height relative to the first joint, m."""
    clock_offset_us: float | None = None
    """UNIX time of the gateway minus monotonic time of this machine, µs; None if unknown."""
    clock_error_us: float = 0.0
    """UNIX time of the gateway minus UNIX time of this machine, µs."""

    def take(self, topic: str, payload: Any, now: Moment) -> None:
        """Process one message; `topic` is relative to the base topic."""
        kind = "device" if topic.startswith("device/") else topic
        try:
            message = decode(topic, payload)
        except UnreadablePayloadError as fault:
            if kind in (*TOPICS, "device"):
                self.faults[kind] = str(fault)
            return
        self.faults.pop(kind, None)
        if message is not None:
            self._reduce(topic, message, now)

    def gateway_us(self, now: Moment) -> float | None:
        """Return the present UNIX time of the gateway, µs; None while unknown."""
        if self.clock_offset_us is None:
            return None
        return self.clock_offset_us + now.monotonic_s * 1e6

    def angle_choices(self) -> list[AngleChoice]:
        """Return all angles of the rig, in the order of its joints."""
        if self.pose is None:
            return []
        names = self.info.joints if self.info is not None else [*self.pose.joints]
        return [
            (name, key)
            for name in names
            if name in self.pose.joints
            for key in type(self.pose.joints[name]).model_fields
            if key.endswith("_deg")
            and key != "sd_deg"
            and key in self.pose.joints[name].model_fields_set
        ]

    def _reduce(self, topic: str, message: BaseModel, now: Moment) -> None:
        match message:
            case Pose():
                self._take_pose(message, now)
            case OpticalPose():
                self.optical, self.optical_s = message, now.monotonic_s
                _append(self.opticals, _angles(message))
            case State() if topic == "bridge/state":
                self.bridge = message.state
            case State():
                _bounded_set(self.availability, topic.split("/")[1], message.state)
            case Info():
                self.info = message
            case Health():
                self.health = message
            case CalibrationState():
                self._take_calibration(message)
            case Progress():
                self.progress = message
            case EventMessage():
                self.events.appendleft(message)
                _bounded_set(self.last_events, message.id, message)
            case _:
                pass

    def _take_pose(self, pose: Pose, now: Moment) -> None:
        # If a pose is older than the previous pose, the daemon restarted or its clock was set. The
        # curve then restarts.
        if self.pose is not None and pose.t_us < self.pose.t_us:
            self.poses.clear()
            self.opticals.clear()
            self.clock_offset_us = None
        self.pose, self.pose_s = pose, now.monotonic_s
        _append(self.poses, _angles(pose))
        self._extend_reach(pose)

        # The smallest delay between time stamp and receipt determines the conversion of the time of
        # this machine to gateway time.
        offset_us = pose.t_us - now.monotonic_s * 1e6
        if self.clock_offset_us is None or offset_us > self.clock_offset_us:
            self.clock_offset_us = offset_us
            self.clock_error_us = pose.t_us - now.unix_us

    def _extend_reach(self, pose: Pose) -> None:
        points = [known_vector(joint.p_m, 3) for joint in pose.joints.values()]
        known = [point for point in points if point is not None]
        if not known:
            return
        (x0, y0, z0), reach = known[0], self.reach_m
        for x, y, z in known[1:]:
            reach[0] = max(reach[0], math.hypot(x - x0, y - y0))
            reach[1] = min(reach[1], z - z0)
            reach[2] = max(reach[2], z - z0)

    def _take_calibration(self, calibration: CalibrationState) -> None:
        before = self.calibration
        if before is None or before.version != calibration.version:
            self.reach_m = [0.0, 0.0, 0.0]
        self.calibration = calibration
        if self.progress is not None and self.progress.phase != calibration.phase:
            self.progress = None


def known_vector(vector: list[float | None] | None, length: int) -> list[float] | None:
    """Return the components of a vector; None if a component is unknown."""
    if vector is None or len(vector) != length:
        return None
    known = [value for value in vector if value is not None and math.isfinite(value)]
    return known if len(known) == length else None


def _angles(pose: Pose | OpticalPose) -> AngleSample:
    """Return the angles of all joints in a pose."""
    return AngleSample(
        pose.t_us,
        {
            (name, key): getattr(joint, key)
            for name, joint in pose.joints.items()
            for key in joint.model_fields_set
            if key.endswith("_deg") and key != "sd_deg"
        },
    )


def _append(samples: deque[AngleSample], sample: AngleSample) -> None:
    """Append a sample; remove samples that are older than the time range of the curve."""
    samples.append(sample)
    oldest_us = sample.t_us - SHOWN_S * 1e6
    while samples[0].t_us < oldest_us:
        samples.popleft()


def _bounded_set(table: dict[str, Any], key: str, value: Any) -> None:
    """Set a key of a table; remove the oldest keys beyond `_MOST_DEVICES`."""
    table.pop(key, None)
    table[key] = value
    if len(table) > _MOST_DEVICES:
        del table[next(iter(table))]
