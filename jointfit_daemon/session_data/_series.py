"""Series of one session: sensors, markers, segments, joints, and events on the same time line.

Invariant: all arrays of a series have one row for each time. Times are finite and strictly
increasing. A quaternion has unit length, or all its components are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array

_UNIT_TOLERANCE = 1e-3
"""Largest difference of the norm of a quaternion from 1. Payloads round components to 1e-5."""


class SessionDataError(ValueError):
    """Arrays that do not form a series; the message names the series, the finding and a remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorSeries:
    """Samples of an IMU."""

    id: str
    segment: str
    """Segment that carries the sensor; empty if unknown."""
    t_s: Array
    """Instants since the start of the session, s, shape (n,)."""
    orientation: Array
    """Sensor orientations q_world_sensor, shape (n, 4); NaN where unknown."""
    angular_velocity: Array | None = None
    """Angular rate in sensor axes, rad/s, shape (n, 3)."""
    acceleration: Array | None = None
    """Specific force in sensor axes, m/s^2, shape (n, 3). At rest it is 9.81 m/s^2 upward."""
    magnetic_field: Array | None = None
    """Magnetic field in sensor axes, in the unit of the sensor, shape (n, 3)."""

    def __post_init__(self) -> None:
        owner = f"sensor {self.id!r}"
        _check_times(owner, self.t_s)
        _check_orientation(owner, self.orientation, len(self.t_s))
        for name in ("angular_velocity", "acceleration", "magnetic_field"):
            _check_shape(owner, name, getattr(self, name), (len(self.t_s), 3))


@dataclass(frozen=True, slots=True, eq=False)
class MarkerSeries:
    """Positions of all optical markers."""

    labels: tuple[str, ...]
    t_s: Array
    """Instants since the start of the session, s, shape (n,)."""
    positions: Array
    """Positions of the markers in the optical world, z up, m, shape (n, len(labels), 3); NaN where
    occluded."""

    def __post_init__(self) -> None:
        owner = "markers"
        check_unique(owner, self.labels)
        _check_times(owner, self.t_s)
        _check_shape(owner, "positions", self.positions, (len(self.t_s), len(self.labels), 3))


@dataclass(frozen=True, slots=True, eq=False)
class SegmentSeries:
    """Orientations of a segment."""

    name: str
    t_s: Array
    """Instants since the start of the session, s, shape (n,)."""
    orientation: Array
    """Segment orientations q_world_segment, shape (n, 4); NaN where unknown."""
    sd_rad: Array | None = None
    """Standard deviation per axis, rad, shape (n,); NaN where unknown."""

    def __post_init__(self) -> None:
        owner = f"segment {self.name!r}"
        _check_times(owner, self.t_s)
        _check_orientation(owner, self.orientation, len(self.t_s))
        _check_shape(owner, "sd_rad", self.sd_rad, (len(self.t_s),))


@dataclass(frozen=True, slots=True, eq=False)
class JointSeries:
    """Angles and position of a joint."""

    name: str
    t_s: Array
    """Instants since the start of the session, s, shape (n,)."""
    angles: Mapping[str, Array] = field(default_factory=dict)
    """Angles by name (``flexion``, ``adduction`` ...), rad, shape (n,); NaN where unknown."""
    angle_sd: Mapping[str, Array] = field(default_factory=dict)
    """Standard deviations by name of the angle, rad, shape (n,). Names without an estimate are left
    out."""
    position: Array | None = None
    """Joint center in the world, m, shape (n, 3)."""
    position_sd: Array | None = None
    """Standard deviation of the position per axis, m, shape (n,)."""

    def __post_init__(self) -> None:
        owner, count = f"joint {self.name!r}", len(self.t_s)
        _check_times(owner, self.t_s)
        for name, values in self.angles.items():
            _check_shape(owner, f"angle {name!r}", values, (count,))
        for name, values in self.angle_sd.items():
            _check_shape(owner, f"standard deviation of {name!r}", values, (count,))
        without_angle = sorted(self.angle_sd.keys() - self.angles.keys())
        if without_angle:
            raise SessionDataError(
                f"{owner}: standard deviation of {', '.join(without_angle)} without the angle:"
                " add the angle"
            )
        _check_shape(owner, "position", self.position, (count, 3))
        _check_shape(owner, "position_sd", self.position_sd, (count,))


@dataclass(frozen=True, slots=True, eq=False)
class FrameSeries:
    """Mode and flags of the frames that were computed from the sensors."""

    t_s: Array
    """Instants since the start of the session, s, shape (n,)."""
    modes: tuple[str, ...]
    """Mode of each frame, such as ``imu`` (`FusionMode`)."""
    flags: tuple[str, ...]
    """Flags of each frame (`FrameFlag`), separated by blanks; empty without flags."""

    def __post_init__(self) -> None:
        _check_times("frames", self.t_s)
        if not len(self.t_s) == len(self.modes) == len(self.flags):
            raise SessionDataError(
                f"frames: {len(self.modes)} modes and {len(self.flags)} flags, expected"
                f" {len(self.t_s)}: one of each for each time"
            )


@dataclass(frozen=True, slots=True)
class TimelineEvent:
    """Event at an instant, such as a mark, a phase, a fault or a gap."""

    t_s: float
    """Instant since the start of the session, s."""
    kind: str
    """Kind of the event in one word, such as ``mark``, ``phase`` or ``device``."""
    id: str = ""
    """Sensor, segment or phase to which the event belongs; empty for the whole session."""
    text: str = ""
    data: Mapping[str, object] = field(default_factory=dict)
    """Further values of the event, which have JSON types."""


def _check_times(owner: str, t_s: Array) -> None:
    if t_s.ndim != 1 or t_s.dtype != np.float64:
        raise SessionDataError(
            f"{owner}: times have shape {t_s.shape} and type {t_s.dtype}, expected (n,) and float64"
        )
    if not np.isfinite(t_s).all():
        row = int(np.argmin(np.isfinite(t_s))) + 1
        raise SessionDataError(f"{owner}: row {row} has no time: leave the row out")

    backwards = np.flatnonzero(np.diff(t_s) <= 0.0)
    if backwards.size:
        row = int(backwards[0]) + 1
        raise SessionDataError(
            f"{owner}: time does not increase from row {row} ({t_s[row - 1]:.6f} s) to row"
            f" {row + 1} ({t_s[row]:.6f} s): sort the rows, or leave out repeated ones"
        )


def _check_shape(owner: str, name: str, values: Array | None, shape: tuple[int, ...]) -> None:
    if values is not None and values.shape != shape:
        raise SessionDataError(
            f"{owner}: {name} has shape {values.shape}, expected {shape}: one row for each time"
        )


def _check_orientation(owner: str, q: Array, count: int) -> None:
    _check_shape(owner, "orientation", q, (count, 4))
    wrong = np.abs(np.linalg.norm(q, axis=1) - 1.0) > _UNIT_TOLERANCE
    wrong |= np.isnan(q).any(axis=1) != np.isnan(q).all(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise SessionDataError(
            f"{owner}: row {row + 1}: quaternion {q[row].tolist()} is not of unit length:"
            " normalize it, or set it to NaN"
        )


def check_unique(owner: str, names: tuple[str, ...]) -> None:
    for name in names:
        if not name.isprintable() or not name.strip():
            raise SessionDataError(
                f"{owner}: name {name!r} is empty or has control characters: rename it"
            )
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise SessionDataError(
            f"{owner}: {', '.join(map(repr, repeated))} occurs more than once: rename all but one"
        )
