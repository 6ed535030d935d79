"""Detection of sensor slip by comparing pairs of sensors of one segment with the calibration.

The calibration predicts the rotation between two sensors of a segment from posture
(`limb_model.SensorLink`). The *difference* of the pair is the measured minus the predicted rotation
vector. If it exceeds the usual difference, the uncertainty increases immediately. The pair is
reported as inconsistent only if the difference stays above a limit for `ONSET_NS`. The pair is
reported as consistent again after the difference has been well below the limit for `RELEASE_NS`.
"""

from __future__ import annotations

from collections import Counter, deque
from math import exp, hypot, radians, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.rotation_scalar import difference_one, exp_one
from jointfit_daemon.limb_model import SensorLink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Quaternion, Vector

SMOOTHING_S = 0.4
"""Time constant of the difference that is compared with the limit, s."""
ONSET_NS = 500_000_000
"""Time above the limit after which a pair is inconsistent, ns."""
RELEASE_NS = 2_000_000_000
"""Time below the release limit after which the pair is consistent again, ns."""
LIMIT_FACTOR = 2.4
"""Limit of the smoothed difference in units of its usual RMS length. Without a fault the smoothed
difference stays below 1.5 of these units for hours with simulated soft tissue. It stays below 2.1
units in recorded movements outside the training range.
"""
MIN_LIMIT = radians(6.0)
"""Smallest limit, rad."""
RELEASE_SHARE = 0.65
"""Fraction of the limit below which an inconsistency may end."""
TILT_SHARE = 0.75
"""Fraction of the limit above which the part of a difference that is not a rotation about the
vertical counts as a tilt. A smaller part may be soft-tissue artefact.
"""
USUAL_FACTOR = 1.5
"""Largest usual difference of a single frame, in units of its RMS length."""
USUAL_MEAN_FACTOR = 1.2
"""Largest usual mean difference over :data:`MEAN_S`, in units of the RMS length."""
MEAN_S = 1.0
"""Time constant of the mean difference, s."""
RECENT_FRAMES = 10
"""Number of updates over which sudden changes are measured: 0.4 s."""
UNTRAINED_SD = radians(5.0)
"""Standard deviation per component of the difference of a pair that has no training data, rad."""


def untrained_link(a: str, b: str) -> SensorLink:
    """Return the link of a pair without training data; it always predicts the rotation 0."""
    zero = (0.0,) * 10
    return SensorLink(a, b, "pair", (), (zero, zero, zero), zero, zero, 0.0, UNTRAINED_SD)


def pair_corrections(pairs: Sequence[SlipDetector]) -> dict[str, Quaternion]:
    """Return the rotations that reduce the differences of a segment's sensors to the usual size.

    The excess of each pair is divided equally, because neither sensor is known to be wrong. The
    rotations are in segment axes.
    """
    of_sensor = Counter(name for pair in pairs for name in (pair.link.a, pair.link.b))
    corrections = {}

    for name, count in of_sensor.items():
        x = y = z = 0.0
        for pair in pairs:
            if pair.exceeded and name in (pair.link.a, pair.link.b):
                share = (1.0 if name == pair.link.a else -1.0) / (count + 1)
                vx, vy, vz = pair.excess_vector
                x, y, z = x + share * vx, y + share * vy, z + share * vz
        corrections[name] = exp_one((x, y, z))
    return corrections


class FaultDebouncer:
    """Sets and clears a fault from a difference and its limit.

    The fault is set after the difference was above the limit for `ONSET_NS`. It is cleared after
    the difference was below `RELEASE_SHARE` times the limit for `RELEASE_NS`.
    """

    def __init__(self) -> None:
        self.active = False
        self._since_ns: int | None = None

    def restart(self) -> None:
        """Restart the time measurement; the fault state is unchanged."""
        self._since_ns = None

    def update(self, t_ns: int, difference: float, limit: float) -> bool:
        """Add a difference; return whether this difference began or ended the fault."""
        pending = difference < RELEASE_SHARE * limit if self.active else difference > limit
        if not pending:
            self._since_ns = None
            return False

        if self._since_ns is None:
            self._since_ns = t_ns
        if t_ns - self._since_ns < (RELEASE_NS if self.active else ONSET_NS):
            return False
        self.active, self._since_ns = not self.active, None
        return True


class SlipDetector:
    """Compares two sensors of one segment with their calibrated relation.

    Parameters
    ----------
    link : SensorLink
        Relation of the pair from the calibration.
    """

    def __init__(self, link: SensorLink) -> None:
        self.link = link
        self._smooth: Vector = (0.0, 0.0, 0.0)
        self._tilt: Vector = (0.0, 0.0, 0.0)
        self._mean: Vector = (0.0, 0.0, 0.0)
        self._recent: deque[Vector] = deque(maxlen=RECENT_FRAMES)
        self._usual = 0.0
        self._before_ns: int | None = None
        self._debouncer = FaultDebouncer()
        self.changed = False
        """Whether the last update began or ended the inconsistency."""
        self.distance = 0.0
        """Smoothed difference from the predicted rotation, rad."""
        self.limit = MIN_LIMIT
        """Distance above which the pair is inconsistent, rad."""
        self.excess = 0.0
        """Largest of three excesses over the usual value, rad: excess of the last difference, of
        its change within 0.4 s, and of the mean difference."""
        self.excess_vector: Vector = (0.0, 0.0, 0.0)
        """Excess of the last difference as the rotation vector from a to b in segment axes, rad;
        valid if `exceeded`."""
        self.exceeded = False
        """Whether the last difference was larger than usual."""
        self.heading = 0.0
        """Vertical component of the last difference from a to b, before the correction of magnetic
        disturbances, rad."""

    @property
    def inconsistent(self) -> bool:
        """Whether the pair contradicts its calibrated relation persistently."""
        return self._debouncer.active

    @property
    def tilted(self) -> bool:
        """Whether an active or pending inconsistency contains a tilt.

        A tilt is a rotation about a horizontal axis by more than `TILT_SHARE` times the limit. An
        inconsistency without a tilt is a difference in heading.
        """
        return not self.consistent and hypot(*self._tilt) > TILT_SHARE * self.limit

    @property
    def consistent(self) -> bool:
        """Whether no inconsistency is active or pending; the difference may then be drift."""
        return not self.inconsistent and self.distance < self.limit

    def clear_excess(self) -> None:
        """Clear the excess, because a sensor of the pair sends no data."""
        self.excess, self.exceeded = 0.0, False

    def update(
        self,
        t_ns: int,
        a: Quaternion,
        b: Quaternion,
        verticals: tuple[Vector, Vector | None],
        *,
        correction: float = 0.0,
    ) -> None:
        """Add the bone-aligned orientations of both sensors.

        Parameters
        ----------
        t_ns : int
            Instant of the frame.
        a, b : Quaternion
            q_world_segment computed from each sensor.
        verticals : tuple of Vector
            The vertical in the frame of `a` and in the frame of the neighboring segment; the second
            is None if unknown.
        correction : float
            Correction of the heading from a to b that `a` and `b` already contain, rad.
        """
        up_a, up_near = verticals
        (ex, ey, ez), sd = self.link.predict(up_a, up_near)
        dx, dy, dz = difference_one(a, b)
        residual = rx, ry, rz = dx - ex, dy - ey, dz - ez
        usual = sqrt(3.0) * sd

        # The difference is split into heading (about the vertical) and tilt. The limit applies to
        # the difference before the correction.
        ux, uy, uz = up_a
        heading = rx * ux + ry * uy + rz * uz
        self.heading = heading + correction
        tilt = (rx - heading * ux, ry - heading * uy, rz - heading * uz)
        uncorrected = (rx + correction * ux, ry + correction * uy, rz + correction * uz)

        self._smooth_differences(t_ns, uncorrected, residual, tilt, usual=usual)

        # The largest of three excesses counts: of this difference, of the mean, and of the change.
        length = hypot(*residual)
        beyond = max(0.0, length - USUAL_FACTOR * usual)
        self.exceeded = beyond > 0.0
        if self.exceeded:
            share = beyond / length
            self.excess_vector = (share * residual[0], share * residual[1], share * residual[2])

        x, y, z = self._recent[0]
        self._recent.append(residual)
        change = hypot(residual[0] - x, residual[1] - y, residual[2] - z) - USUAL_FACTOR * usual
        mean = hypot(*self._mean) - USUAL_MEAN_FACTOR * usual
        self.excess = max(beyond, change, mean)

        self.changed = self._debouncer.update(t_ns, self.distance, self.limit)

    def _smooth_differences(
        self, t_ns: int, uncorrected: Vector, residual: Vector, tilt: Vector, *, usual: float
    ) -> None:
        if self._before_ns is None or t_ns - self._before_ns > ONSET_NS:
            self._smooth = self._tilt = (0.0, 0.0, 0.0)
            self._mean = residual
            self._recent.clear()
            self._recent.append(residual)
            self._usual, self._before_ns = usual, t_ns
            self._debouncer.restart()

        dt = (t_ns - self._before_ns) * 1e-9
        gain = 1.0 - exp(-dt / SMOOTHING_S)
        self._before_ns = t_ns
        self._mean = _blend(self._mean, residual, 1.0 - exp(-dt / MEAN_S))
        self._smooth = _blend(self._smooth, uncorrected, gain)
        self._tilt = _blend(self._tilt, tilt, gain)
        self._usual += gain * (usual - self._usual)
        self.distance = hypot(*self._smooth)
        self.limit = max(MIN_LIMIT, LIMIT_FACTOR * self._usual)


def _blend(x: Vector, y: Vector, gain: float) -> Vector:
    return (
        x[0] + gain * (y[0] - x[0]),
        x[1] + gain * (y[1] - x[1]),
        x[2] + gain * (y[2] - x[2]),
    )
