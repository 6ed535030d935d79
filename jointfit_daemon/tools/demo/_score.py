"""Errors of the published limb state relative to the ground truth in the simulator's log."""

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
class TrueLimbState:
    """Ground truth of the limb at one time."""

    t_ns: int
    motion: str
    orientations: Mapping[str, Quaternion]
    """Segment orientations q_world_segment in the optical world."""
    centers: Mapping[str, Vector]
    """Joint centres in the optical world, m."""
    flexion: float
    """Flexion of the main joint, rad: knee (heel back), elbow or lumbar joint (forward)."""


class TruthTrack:
    """Ground truth over time, interpolated between samples."""

    def __init__(self) -> None:
        self._rows: list[TrueLimbState] = []
        self._times: list[int] = []

    def add(self, row: TrueLimbState) -> None:
        """Append a sample, which must be later than all others."""
        self._rows.append(row)
        self._times.append(row.t_ns)

    def at(self, t_ns: int) -> TrueLimbState | None:
        """Return the ground truth at `t_ns`, or None outside the recorded interval."""
        k = bisect.bisect_right(self._times, t_ns)
        if not 0 < k < len(self._rows):
            return None

        before, after = self._rows[k - 1], self._rows[k]
        share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)

        return TrueLimbState(
            t_ns,
            before.motion,
            {
                name: interpolate_one(q, after.orientations[name], share)
                for name, q in before.orientations.items()
            },
            {
                name: _interpolate(p, after.centers[name], share)
                for name, p in before.centers.items()
            },
            before.flexion + share * (after.flexion - before.flexion),
        )


def _interpolate(a: Vector, b: Vector, share: float) -> Vector:
    return (
        a[0] + share * (b[0] - a[0]),
        a[1] + share * (b[1] - a[1]),
        a[2] + share * (b[2] - a[2]),
    )


@dataclass(slots=True)
class RmsAccumulator:
    """Running root mean square."""

    n: int = 0
    total: float = 0.0

    def add(self, value: float) -> None:
        """Add one value."""
        self.n += 1
        self.total += value * value

    @property
    def rms(self) -> float | None:
        """Return the RMS, or None without values."""
        return math.sqrt(self.total / self.n) if self.n else None


@dataclass(slots=True)
class DemoScore:
    """Statistics of the errors of published poses relative to the ground truth."""

    flexion: RmsAccumulator = field(default_factory=RmsAccumulator)
    segments: dict[str, RmsAccumulator] = field(default_factory=dict)
    frames: int = 0
    covered: int = 0
    """Number of frames whose flexion error is within two published standard deviations."""

    def add(self, pose: Mapping[str, object], truth: TrueLimbState, joint: str) -> None:
        """Compare a ``pose`` payload with `truth`; `joint` selects the joint for the flexion."""
        self.frames += 1
        for name, segment in _table(pose, "segments").items():
            q = segment.get("q")
            if isinstance(q, list) and name in truth.orientations:
                w, x, y, z = map(float, q)
                error = angle_between_one((w, x, y, z), truth.orientations[name])
                self.segments.setdefault(name, RmsAccumulator()).add(math.degrees(error))

        angles = _table(pose, "joints").get(joint, {})
        flexion, sd = angles.get("flexion_deg"), angles.get("sd_deg")
        if not isinstance(flexion, int | float):
            return

        error_deg = flexion - math.degrees(truth.flexion)
        self.flexion.add(error_deg)
        self.covered += isinstance(sd, int | float) and abs(error_deg) <= 2 * sd


def _table(pose: Mapping[str, object], key: str) -> dict[str, dict[str, object]]:
    value = pose.get(key)
    return value if isinstance(value, dict) else {}


def percentile(values: Sequence[float], share: float) -> float | None:
    """Return the `share` quantile (0 to 1) of the values, or None without values."""
    if not values:
        return None
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
