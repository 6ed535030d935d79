"""How far the daemon's limb is from the simulator's bones. Law: pure; numbers in, figures out.

The truth is read from the simulator's log, never from anything the daemon saw.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.rotation_scalar import angle_between_one, interpolate_one

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Quaternion, Vector


@dataclass(frozen=True, slots=True)
class Truth:
    """The bones at one instant."""

    t_ns: int
    motion: str
    orientations: Mapping[str, Quaternion]
    """q_world_segment in the optical world."""
    centers: Mapping[str, Vector]
    """Joint centres in the optical world, m."""
    flexion: float
    """Knee flexion, rad, positive heel back."""


class TruthTrack:
    """Truth over time, in order; interpolated between its rows."""

    def __init__(self) -> None:
        self._rows: list[Truth] = []
        self._times: list[int] = []

    def add(self, row: Truth) -> None:
        """Append a row; rows come in order of time."""
        self._rows.append(row)
        self._times.append(row.t_ns)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def last(self) -> Truth | None:
        """Return the newest row."""
        return self._rows[-1] if self._rows else None

    def at(self, t_ns: int) -> Truth | None:
        """Return the truth at an instant, or None outside what is known yet."""
        k = bisect.bisect_right(self._times, t_ns)
        if not 0 < k < len(self._rows):
            return None
        before, after = self._rows[k - 1], self._rows[k]
        share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
        return Truth(
            t_ns,
            before.motion,
            {
                name: interpolate_one(q, after.orientations[name], share)
                for name, q in before.orientations.items()
            },
            {name: _between(p, after.centers[name], share) for name, p in before.centers.items()},
            before.flexion + share * (after.flexion - before.flexion),
        )


def _between(a: Vector, b: Vector, share: float) -> Vector:
    return (
        a[0] + share * (b[0] - a[0]),
        a[1] + share * (b[1] - a[1]),
        a[2] + share * (b[2] - a[2]),
    )


@dataclass(slots=True)
class MeanSquare:
    """Root of the mean of squares, one value at a time."""

    n: int = 0
    total: float = 0.0

    def add(self, value: float) -> None:
        """Take one error."""
        self.n += 1
        self.total += value * value

    @property
    def rms(self) -> float | None:
        """Return the RMS, None before the first value."""
        return math.sqrt(self.total / self.n) if self.n else None


@dataclass(slots=True)
class Score:
    """Errors of the published limb against the bones."""

    flexion: MeanSquare = field(default_factory=MeanSquare)
    segments: dict[str, MeanSquare] = field(default_factory=dict)
    frames: int = 0
    unknown: int = 0
    """Frames whose knee the daemon did not know."""
    covered: int = 0
    """Frames whose knee flexion error was within two of its own standard deviations."""

    def add(self, pose: Mapping[str, object], truth: Truth, joint: str) -> None:
        """Compare one ``pose`` payload with the truth at its instant."""
        self.frames += 1
        for name, segment in _table(pose, "segments").items():
            q = segment.get("q")
            if isinstance(q, list) and name in truth.orientations:
                error = angle_between_one(_quaternion(q), truth.orientations[name])
                self.segments.setdefault(name, MeanSquare()).add(math.degrees(error))
        knee = _table(pose, "joints").get(joint, {})
        flexion, sd = knee.get("flexion_deg"), knee.get("sd_deg")
        if not isinstance(flexion, int | float):
            self.unknown += 1
            return
        error_deg = flexion - math.degrees(truth.flexion)
        self.flexion.add(error_deg)
        self.covered += isinstance(sd, int | float) and abs(error_deg) <= 2 * sd


def _table(pose: Mapping[str, object], key: str) -> dict[str, dict[str, object]]:
    value = pose.get(key)
    return value if isinstance(value, dict) else {}


def _quaternion(q: Sequence[float]) -> Quaternion:
    return (float(q[0]), float(q[1]), float(q[2]), float(q[3]))


def percentile(values: Sequence[float], share: float) -> float | None:
    """Return the value below which `share` of the sorted values lie; None of nothing."""
    if not values:
        return None
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
