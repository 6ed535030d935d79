"""Sensors that go on talking and say nothing new.

Law: pure, O(1) a frame, indifferent to mounts and worlds: only how far each sensor turned counts.

A sensor is stuck when it repeats itself to the last bit while its partner on the same segment
turns, or when it stays behind while its partner turns a long way. A live sensor never repeats
itself for long; how long one does by nature (coarse digits, a slow filter) is learnt from runs that
ended by themselves. It is trusted again after it has moved for a fifth of a second.
"""

from __future__ import annotations

from math import radians, sin
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Quaternion

    Orientations = Mapping[str, Quaternion]

REPEATS_NS = 50_000_000
"""Shorter repetitions are nobody's concern."""
REPEATS_AT_REST_NS = 400_000_000
"""A sensor known to move always is stuck after this, if another one is lively."""
KNOWN_NS = 5_000_000_000
"""Time of watching after which it is known how a sensor behaves."""
NATURAL_FACTOR, NATURAL_MOST_NS = 3, 150_000_000
PARTNER = radians(1.0)
"""Turn of another sensor on the same segment that no live sensor sleeps through."""
NEIGHBOR, NEIGHBOR_NS = radians(10.0), 300_000_000
"""The same of a sensor on another segment, and how long it must have been slept through."""
WINDOW_NS = 150_000_000
FAR, SHARE = radians(6.0), 0.05
"""Turn of a partner within one window, and the share of it that even a loose sensor follows. Two
windows in a row must say so: nobody turns back at the same moment twice."""
TRUSTED_NS = 200_000_000
_ROUNDING = 1e-12
"""Squared sine of half a turn that is rounding: 2e-6 rad."""


class _Sensor:
    __slots__ = (
        "asleep", "awake_ns", "behind", "everyone", "first_ns", "natural_ns", "partners", "q",
        "since_ns", "still", "strangers",
    )  # fmt: skip

    def __init__(self, partners: tuple[str, ...], strangers: tuple[str, ...]) -> None:
        self.partners, self.strangers = partners, strangers
        self.since_ns: int | None = None
        """Since when it says the same; None: it says nothing."""
        self.q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        """What it says since then."""
        self.everyone: Orientations = {}
        """What all sensors said then."""
        self.first_ns: int | None = None
        self.natural_ns = 0
        self.asleep = self.behind = self.still = False
        self.awake_ns = 0
        """Last instant at which it repeated itself."""

    def take(self, t_ns: int, q: Quaternion, everyone: Orientations) -> bool:
        """Take one orientation; tell whether it is the one before again."""
        since_ns = self.since_ns
        if since_ns is not None and _repeats(self.q, q):
            self.awake_ns = t_ns
            return True
        if since_ns is None:
            self.first_ns = t_ns
        elif not self.asleep:
            if t_ns - since_ns > self.natural_ns:
                self.natural_ns = min(t_ns - since_ns, NATURAL_MOST_NS)
        elif t_ns - self.awake_ns >= TRUSTED_NS:
            self.asleep = False
        self.since_ns, self.q, self.everyone = t_ns, q, everyone
        return False

    def forget(self) -> None:
        """Take it that it says nothing: what it says next is not compared with what it said."""
        self.since_ns = None
        self.asleep = self.behind = self.still = False


class FrozenWatch:
    """Finds sensors that are stuck.

    Parameters
    ----------
    groups : sequence of sequence of str
        Sensor ids by segment.
    """

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        everyone = [name for group in groups for name in group]
        self._sensors = {
            name: _Sensor(
                tuple(other for other in group if other != name),
                tuple(other for other in everyone if other not in group),
            )
            for group in groups
            for name in group
        }
        self._items = tuple(self._sensors.items())
        self._window: tuple[int, Orientations] | None = None

    def look(self, t_ns: int, said: Orientations) -> list[str]:
        """Return the sensors that are stuck at `t_ns`, of those that say something.

        Parameters
        ----------
        t_ns : int
            Instant of the frame; grows from call to call.
        said : mapping of str to Quaternion
            Orientation by sensor, each in any world of its own. It is kept for a while: the caller
            must not change it.
        """
        repeating = []
        for name, one in self._items:
            q = said.get(name)
            if q is None:
                one.forget()
            elif one.take(t_ns, q, said):
                repeating.append(name)
        for name in repeating:
            one = self._sensors[name]
            one.asleep = one.asleep or self._asleep(one, t_ns, said, repeating)
        if self._window is None or t_ns - self._window[0] >= WINDOW_NS:
            if self._window is not None:
                self._leave_behind(self._window[1], said)
            self._window = (t_ns, said)
        return [name for name, one in self._items if one.asleep or one.behind]

    def _asleep(
        self, one: _Sensor, t_ns: int, said: Orientations, repeating: Sequence[str]
    ) -> bool:
        """Tell whether others turned, or live on, while `one` repeats itself."""
        since_ns, first_ns = one.since_ns, one.first_ns
        if since_ns is None or first_ns is None:
            return False
        length_ns, usual_ns = t_ns - since_ns, NATURAL_FACTOR * one.natural_ns
        if length_ns < max(REPEATS_NS, usual_ns):
            return False
        then = one.everyone
        if any(_turned(name, then, said, PARTNER) for name in one.partners):
            return True
        if length_ns >= NEIGHBOR_NS and any(
            _turned(name, then, said, NEIGHBOR) for name in one.strangers
        ):
            return True
        if length_ns < REPEATS_AT_REST_NS or since_ns - first_ns < KNOWN_NS:
            return False
        return any(
            name in said and name not in repeating for name in (*one.partners, *one.strangers)
        )

    def _leave_behind(self, then: Orientations, said: Orientations) -> None:
        """Compare turns over one window: who hardly moves while a partner goes far is stuck."""
        for name, one in self._items:
            if any(_turned(other, then, said, FAR) for other in one.partners):
                known = name in then and name in said
                before, one.still = one.still, known and not _turned(name, then, said, SHARE * FAR)
                one.behind = before and one.still


def _repeats(a: Quaternion, b: Quaternion) -> bool:
    """Tell whether two orientations differ by rounding; mostly one component denies it."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    x = aw * bx - ax * bw - ay * bz + az * by
    return x * x < _ROUNDING and _sine2(a, b) < _ROUNDING


def _sine2(a: Quaternion, b: Quaternion) -> float:
    """Return the squared sine of half the turn between two orientations."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by + ax * bz - ay * bw - az * bx
    z = aw * bz - ax * by + ay * bx - az * bw
    return x * x + y * y + z * z


def _turned(name: str, then: Orientations, now: Orientations, least: float) -> bool:
    """Tell whether a sensor has turned by `least` rad or more between two frames."""
    a, b = then.get(name), now.get(name)
    if a is None or b is None:
        return False
    return _sine2(a, b) >= sin(0.5 * least) ** 2
