"""Detection of stuck sensors, which continue to send but no longer follow their segment.

A sensor is stuck in each of three cases:

* It repeats its orientation while another sensor turns.
* It repeats its orientation for longer while the limb is at rest and another sensor shows noise.
* It hardly rotates while its partner, another sensor on the same segment, rotates far.

A working sensor may also repeat its value, because of coarse resolution or a slow filter. The
*natural repetition time* of a sensor is the longest repetition that ended without a fault. A sensor
that repeated its orientation is used again after 0.2 s of movement, and a sensor that hardly
rotated after one window in which it follows its partner.

Sensors without noise do not start or stop moving in the same frame, because their sampling instants
differ, and because a delayed sample is extrapolated from rest. Only the part of a repetition in
which another sensor varied therefore counts.

Invariant: only rotations of a sensor relative to its own earlier orientation are compared. The
result therefore does not depend on the alignment or the world of the sensor. The cost per frame is
O(1).
"""

from __future__ import annotations

from math import radians, sin
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Quaternion

    Orientations = Mapping[str, Quaternion]

REPEAT_NS = 50_000_000
"""Shortest repetition that can count as stuck, ns."""
REPEAT_AT_REST_NS = 400_000_000
"""Shortest repetition of a sensor at rest that counts as stuck if another sensor still varies, ns.
"""
OBSERVATION_NS = 5_000_000_000
"""Shortest time from the first sample of a sensor to a repetition at rest that counts as stuck, ns.
Before this time, it is not known whether the sensor has noise.
"""
NATURAL_FACTOR = 3
"""Repetitions up to this multiple of the natural repetition time are not a fault."""
NATURAL_LIMIT_NS = 150_000_000
"""Largest natural repetition time that is used, ns. A longer time would hide a fault."""
PARTNER_ROTATION = radians(1.0)
"""Rotation of a sensor on the same segment that a working sensor always follows, rad."""
OTHER_ROTATION = radians(10.0)
"""Rotation of a sensor on another segment that a working sensor always follows, rad. It is larger
than `PARTNER_ROTATION`, because joints allow one segment to move alone.
"""
OTHER_REPEAT_NS = 300_000_000
"""Shortest repetition that the rotation of another segment can confirm, ns."""
WINDOW_NS = 150_000_000
"""Length of the windows in which rotations of partners are compared, ns."""
WINDOW_ROTATION = radians(6.0)
"""Rotation of a partner within one window that starts a comparison, rad."""
FOLLOWED_SHARE = 0.05
"""Fraction of `WINDOW_ROTATION` that even a loosely attached sensor rotates. A sensor is stuck if
it rotates by less in two such windows in a row. One window is not sufficient, because the sensor
may return to its start within this window.
"""
RECOVERY_NS = 200_000_000
"""Duration of movement after which a stuck sensor is used again, ns."""
_ROUNDING = 1e-12
"""Squared sine of half the angle 2e-6 rad. A smaller rotation is a rounding error."""


class _SensorHistory:
    __slots__ = (
        "first_ns", "lagging", "natural_ns", "orientations", "others", "partners", "q",
        "repeated_ns", "repeating", "since_ns", "still",
    )  # fmt: skip

    def __init__(self, partners: tuple[str, ...], others: tuple[str, ...]) -> None:
        self.partners, self.others = partners, others
        self.since_ns: int | None = None
        """Start of the current repetition; None while the sensor is silent."""
        self.q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        """Orientation at the start of the repetition."""
        self.orientations: Orientations = {}
        """Orientations of all sensors at the start of the repetition."""
        self.first_ns: int | None = None
        self.natural_ns = 0
        self.repeating = self.lagging = self.still = False
        self.repeated_ns = 0
        """Last instant at which the sensor repeated its orientation."""

    def update(self, t_ns: int, q: Quaternion, orientations: Orientations) -> bool:
        """Add an orientation; return whether it equals the preceding orientation."""
        since_ns = self.since_ns
        if since_ns is not None:
            # In most cases one component shows that the orientations differ by more than rounding.
            (aw, ax, ay, az), (bw, bx, by, bz) = self.q, q
            x = aw * bx - ax * bw - ay * bz + az * by
            if x * x < _ROUNDING and _squared_half_sine(self.q, q) < _ROUNDING:
                self.repeated_ns = t_ns
                return True

        if since_ns is None:
            self.first_ns = t_ns
        elif not self.repeating:
            if t_ns - since_ns > self.natural_ns:
                self.natural_ns = min(t_ns - since_ns, NATURAL_LIMIT_NS)
        elif t_ns - self.repeated_ns >= RECOVERY_NS:
            self.repeating = False

        self.since_ns, self.q, self.orientations = t_ns, q, orientations
        return False

    def reset(self) -> None:
        """Mark the sensor as silent, so that the next orientation is not compared with the last."""
        self.since_ns = None
        self.repeating = self.lagging = self.still = False


class StuckSensorDetector:
    """Detects stuck sensors of one limb.

    Parameters
    ----------
    groups : sequence of sequence of str
        Sensor ids by segment.
    """

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        sensors = [name for group in groups for name in group]
        self._sensors = {
            name: _SensorHistory(
                tuple(other for other in group if other != name),
                tuple(other for other in sensors if other not in group),
            )
            for group in groups
            for name in group
        }
        self._items = tuple(self._sensors.items())
        self._window: tuple[int, Orientations] | None = None
        self._varying_ns: tuple[int, int] | None = None
        """First and last instant of the current period of variation, ns. A period ends if no sensor
        varies for `REPEAT_AT_REST_NS`.
        """

    def update(self, t_ns: int, orientations: Orientations) -> list[str]:
        """Add one frame and return the ids of the sensors that are stuck.

        Parameters
        ----------
        t_ns : int
            Instant of the frame; increases from call to call.
        orientations : mapping of str to Quaternion
            Orientation by sensor, each in its own world. The detector keeps a reference, so the
            caller must not change the mapping.
        """
        repeating, varying = [], False
        for name, sensor in self._items:
            q = orientations.get(name)
            if q is None:
                sensor.reset()
            elif sensor.update(t_ns, q, orientations):
                repeating.append(name)
            else:
                varying = True
        if varying:
            first_ns, last_ns = self._varying_ns or (t_ns, t_ns)
            if t_ns - last_ns > REPEAT_AT_REST_NS:  # a pause of all sensors ended
                first_ns = t_ns
            self._varying_ns = first_ns, t_ns

        for name in repeating:
            sensor = self._sensors[name]
            sensor.repeating = sensor.repeating or self._is_stuck(
                sensor, t_ns, orientations, repeating
            )

        if self._window is None or t_ns - self._window[0] >= WINDOW_NS:
            if self._window is not None:
                self._update_lagging(self._window[1], orientations)
            self._window = (t_ns, orientations)
        return [name for name, sensor in self._items if sensor.repeating or sensor.lagging]

    def _is_stuck(
        self,
        sensor: _SensorHistory,
        t_ns: int,
        orientations: Orientations,
        repeating: Sequence[str],
    ) -> bool:
        """Return whether other sensors rotate or vary during a repetition of `sensor`."""
        since_ns, first_ns = sensor.since_ns, sensor.first_ns
        if since_ns is None or first_ns is None or self._varying_ns is None:
            return False
        length_ns, usual_ns = t_ns - since_ns, NATURAL_FACTOR * sensor.natural_ns
        varied_first_ns, varied_last_ns = self._varying_ns
        if varied_last_ns - max(since_ns, varied_first_ns) < max(REPEAT_NS, usual_ns):
            return False

        # Case 1: the limb moved.
        start = sensor.orientations
        if any(
            _has_rotated(name, start, orientations, PARTNER_ROTATION) for name in sensor.partners
        ):
            return True
        if length_ns >= OTHER_REPEAT_NS and any(
            _has_rotated(name, start, orientations, OTHER_ROTATION) for name in sensor.others
        ):
            return True

        # Case 2: the limb is at rest. The noise of other sensors shows that orientations should
        # vary.
        if length_ns < REPEAT_AT_REST_NS or since_ns - first_ns < OBSERVATION_NS:
            return False
        return any(
            name in orientations and name not in repeating
            for name in (*sensor.partners, *sensor.others)
        )

    def _update_lagging(self, start: Orientations, end: Orientations) -> None:
        """Mark sensors that hardly rotated in two windows in which a partner rotated far."""
        for name, sensor in self._items:
            if any(_has_rotated(other, start, end, WINDOW_ROTATION) for other in sensor.partners):
                present = name in start and name in end
                before = sensor.still
                sensor.still = present and not _has_rotated(
                    name, start, end, FOLLOWED_SHARE * WINDOW_ROTATION
                )
                sensor.lagging = before and sensor.still


def _squared_half_sine(a: Quaternion, b: Quaternion) -> float:
    """Return the squared sine of half the rotation between two orientations."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by + ax * bz - ay * bw - az * bx
    z = aw * bz - ax * by + ay * bx - az * bw
    return x * x + y * y + z * z


def _has_rotated(name: str, start: Orientations, end: Orientations, angle: float) -> bool:
    """Return whether a sensor rotated by at least `angle` rad between two frames."""
    a, b = start.get(name), end.get(name)
    if a is None or b is None:
        return False
    return _squared_half_sine(a, b) >= sin(0.5 * angle) ** 2
