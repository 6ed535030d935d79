"""Sensors against each other: who slipped, and whose heading drifts.

Law: pure, O(1) a frame; looks at the links that calibration learnt, 25 times a second.

A difference that comes within seconds is a slip, one that comes within minutes and turns about the
vertical is drift. Drift is taken out of the sensors before anything else looks at them. Only
differences can be seen: what all sensors have in common is left alone, so the corrections of the
segments, and of the sensors of each, have the mean 0.
"""

from __future__ import annotations

from itertools import combinations
from math import cos, degrees, radians, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.calibration.sensor_links import axis_heading_one, up_one
from jointfit_daemon.fusion.heading_drift import HeadingDrift
from jointfit_daemon.fusion.pair_watch import PairWatch, untrained
from jointfit_daemon.fusion.sensor_watch import SensorNews

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from jointfit_daemon.calibration.result import Calibration
    from jointfit_daemon.calibration.sensor_links import SensorLink
    from jointfit_daemon.model import Chain, Quaternion, Vector

    Inputs = dict[str, Quaternion]

LOOK_NS = 39_000_000
HINGE_SPREAD = radians(6.0)
"""A joint whose flexion axes turn against each other by more than this, posture aside, is no hinge:
nothing about headings is read from it."""
SEEN_DRIFT = radians(0.2)
"""Headings are corrected from this on."""
TOLD_DRIFT = radians(5.0)
MAJORITY = 3
"""Of fewer sensors on a segment nobody can tell which one slipped."""


class Doubt(NamedTuple):
    """What to make of the segments in this frame."""

    spread: tuple[float, ...]
    """Standard deviation to add, per axis, by segment, rad."""
    slipped: frozenset[str]
    """Sensors that contradict all others of their segment: not to be used."""
    flags: tuple[str, ...]


class _Joint:
    """The headings of two neighboring segments."""

    def __init__(self, links: list[SensorLink], standing: float, *, drifts: bool) -> None:
        hinges = [link for link in links if link.spread <= HINGE_SPREAD]
        self.links, self.standing = hinges, standing
        self.known = bool(hinges) or drifts
        """Whether the drift is looked at, or known to go on unseen."""
        spread = max((link.spread for link in hinges), default=HINGE_SPREAD)
        self.drift = HeadingDrift(spread)


class LinkWatch:
    """Watches the links of one calibrated limb.

    Parameters
    ----------
    chain : Chain
        Who sits where.
    calibration : Calibration
        What was learnt of the links.
    drifting : collection of str
        Sensors that are known to have no north: where nobody looks at their headings, the
        deviation grows without end. Of the others it is not known, and taken to be bounded.
    """

    def __init__(
        self, chain: Chain, calibration: Calibration, drifting: Collection[str] = ()
    ) -> None:
        self._chain = chain
        known = {(link.a, link.b): link for link in calibration.links}
        self._pairs = [
            [PairWatch(known.get((a, b)) or untrained(a, b)) for a, b in combinations(group, 2)]
            for group in chain.sensors
        ]
        self._within = {
            (pair.link.a, pair.link.b): HeadingDrift(pair.link.spread)
            for pairs in self._pairs
            for pair in pairs
            if (pair.link.a, pair.link.b) in known
        }
        self._joints = [
            _Joint(
                [known[a, b] for a in above for b in below if (a, b) in known],
                _standing(calibration, chain.segments[i], chain.segments[i + 1]),
                drifts=any(name in drifting for name in (*above, *below)),
            )
            for i, (above, below) in enumerate(zip(chain.sensors, chain.sensors[1:], strict=False))
        ]
        everyone = [name for group in chain.sensors for name in group]
        self._common = HeadingDrift(0.0) if any(name in drifting for name in everyone) else None
        self._turns: dict[str, float] = dict.fromkeys(calibration.sensor, 0.0)
        """Heading errors that are taken out of the sensors, rad."""
        self._along = [0.0] * len(chain.segments)
        """The part of them that all sensors of a segment have in common, rad."""
        self._restless: set[PairWatch] = set()
        """Pairs that contradict each other, or begin to: mostly none."""
        self._backs: dict[str, tuple[float, float]] = {}
        """cos and sin of half the turn back, of sensors that are corrected."""
        self._next_ns = 0
        self._calm = Doubt((0.0,) * len(chain.segments), frozenset(), ())
        self._doubt = self._calm
        self._news: list[SensorNews] = []
        self._told_drift: set[int] = set()

    # --- every frame -------------------------------------------------------------------------

    def correct(self, inputs: Inputs) -> Inputs:
        """Return the sensors without the drift of their headings."""
        if not self._backs:
            return inputs
        return {
            name: q if (back := self._backs.get(name)) is None else _turned_back(back, q)
            for name, q in inputs.items()
        }

    def look(self, t_ns: int, inputs: Inputs) -> Doubt:
        """Return what is in doubt; look again if it is time. `inputs` are corrected ones."""
        if t_ns < self._next_ns and self._next_ns - t_ns <= LOOK_NS:
            return self._doubt
        self._next_ns = t_ns + LOOK_NS
        ups = {name: up_one(q) for name, q in inputs.items()}
        for pairs in self._pairs:
            for pair in pairs:
                self._look_at_pair(t_ns, pair, inputs, ups)
        for i, joint in enumerate(self._joints):
            self._look_at_joint(i, joint, inputs, ups)
        if self._step(t_ns):
            self._use_headings()
        self._doubt = self._doubts(inputs)
        return self._doubt

    def _look_at_pair(
        self, t_ns: int, pair: PairWatch, inputs: Inputs, ups: Mapping[str, Vector]
    ) -> None:
        link = pair.link
        a, b = inputs.get(link.a), inputs.get(link.b)
        if a is None or b is None:
            pair.excess = 0.0
            return
        teller = next((name for name in link.near if name in ups), None)
        # a posture told by a sensor that slipped would put the blame on this segment, too
        near = None if teller is None or self._in_doubt(teller) else ups[teller]
        pair.look(t_ns, a, b, ups[link.a], near)
        if pair.calm:
            self._restless.discard(pair)
        else:
            self._restless.add(pair)
        drift = self._within.get((link.a, link.b))
        if drift is not None and pair.calm and near is not None:
            drift.look(pair.turned + self._turns[link.b] - self._turns[link.a])
        if pair.changed:
            self._news.append(_told(pair, self._segment(link.a)))

    def _look_at_joint(
        self, i: int, joint: _Joint, inputs: Inputs, ups: Mapping[str, Vector]
    ) -> None:
        for link in joint.links:
            a, b = inputs.get(link.a), inputs.get(link.b)
            if a is None or b is None or self._in_doubt(link.a) or self._in_doubt(link.b):
                continue
            heading = axis_heading_one(a, b)
            if heading is not None:
                (expected,), _ = link.expected(ups[link.a], ups[link.b])
                applied = self._along[i + 1] - self._along[i]
                joint.drift.look(_wrapped(heading - joint.standing - expected) + applied)
            return

    def _segment(self, sensor: str) -> str:
        index = next(i for i, group in enumerate(self._chain.sensors) if sensor in group)
        return self._chain.segments[index]

    def _in_doubt(self, sensor: str) -> bool:
        restless = self._restless
        return bool(restless) and any(sensor in (p.link.a, p.link.b) for p in restless)

    # --- headings, once a second -------------------------------------------------------------

    def _step(self, t_ns: int) -> bool:
        news = [drift.step(t_ns) for drift in self._within.values()]
        news += [joint.drift.step(t_ns) for joint in self._joints]
        if self._common is not None:
            news.append(self._common.step(t_ns))
        return any(news)

    def _use_headings(self) -> None:
        """Work out what to take out of each sensor: sums along the chain, of mean 0."""
        along = [0.0]
        for joint in self._joints:
            along.append(along[-1] + (joint.drift.heading if joint.links else 0.0))
        middle = sum(along) / len(along)
        self._along = [turn - middle for turn in along]
        for i, group in enumerate(self._chain.sensors):
            own = [0.0, *(self._own(group[0], name) for name in group[1:])]
            center = sum(own) / len(own)
            for name, turn in zip(group, own, strict=True):
                self._turns[name] = self._along[i] + turn - center
        corrected = max((abs(turn) for turn in self._turns.values()), default=0.0) > SEEN_DRIFT
        self._backs = (
            {name: (cos(0.5 * turn), -sin(0.5 * turn)) for name, turn in self._turns.items()}
            if corrected
            else {}
        )
        if not corrected:
            self._turns = dict.fromkeys(self._turns, 0.0)
            self._along = [0.0] * len(self._along)
        self._tell_drift()

    def _own(self, first: str, name: str) -> float:
        drift = self._within.get((first, name))
        return 0.0 if drift is None else drift.heading

    def _tell_drift(self) -> None:
        for i, joint in enumerate(self._joints):
            size = abs(joint.drift.heading)
            if i in self._told_drift and size < 0.5 * TOLD_DRIFT:
                self._told_drift.discard(i)
            elif i not in self._told_drift and joint.links and size > TOLD_DRIFT:
                self._told_drift.add(i)
                below, name = self._chain.segments[i + 1], self._chain.joints[i + 1]
                text = (
                    f"its heading has drifted by {degrees(joint.drift.heading):.0f} deg against "
                    f"{self._chain.segments[i]}; {name} tells, and it is taken out. A new static "
                    "pose sets headings anew"
                )
                data = {"heading_deg": round(degrees(joint.drift.heading), 1)}
                self._news.append(SensorNews(below, "drift", text, "info", data))

    # --- doubts ------------------------------------------------------------------------------

    def _doubts(self, inputs: Inputs) -> Doubt:
        spread, slipped, flags = [], set[str](), []
        for i, pairs in enumerate(self._pairs):
            odd = self._odd_one(i, inputs)
            if odd is not None:
                slipped.add(odd)
                flags.append(f"slipped:{odd}")
            elif any(pair.doubtful for pair in pairs):
                flags.append(f"pair_disagrees:{self._chain.segments[i]}")
            sure = [pair.excess for pair in pairs if odd not in (pair.link.a, pair.link.b)]
            spread.append(max(sure, default=0.0) / sqrt(3.0))
        for i, joint in enumerate(self._joints):
            extra2 = max(0.0, joint.drift.sd**2 - joint.drift.least_sd**2) if joint.known else 0.0
            for k in (i, i + 1):
                spread[k] = sqrt(spread[k] ** 2 + extra2 / 6.0)
        if self.common_sd > TOLD_DRIFT:
            flags.append("heading_unseen")
        if not slipped and not flags and not any(spread):
            return self._calm
        return Doubt(tuple(spread), frozenset(slipped), tuple(flags))

    def _odd_one(self, i: int, inputs: Inputs) -> str | None:
        """Return the one sensor that contradicts all others of its segment, who agree."""
        group = self._chain.sensors[i]
        here = [name for name in group if name in inputs] if len(group) >= MAJORITY else []
        if len(here) < MAJORITY:
            return None
        against = [
            (pair.link.a, pair.link.b)
            for pair in self._pairs[i]
            if pair.doubtful and pair.link.a in here and pair.link.b in here
        ]
        for name in here:
            if len(against) == len(here) - 1 and all(name in pair for pair in against):
                return name
        return None

    @property
    def common_sd(self) -> float:
        """Standard deviation of the heading that all segments share, rad; nobody here sees it."""
        return 0.0 if self._common is None else self._common.sd

    # --- out ---------------------------------------------------------------------------------

    def news(self) -> list[SensorNews]:
        """Return what is worth telling, each change once."""
        if not self._news:
            return []
        told, self._news = self._news, []
        return told

    def health(self) -> dict[str, object]:
        """Return, JSON-able, how far pairs are apart and headings have drifted."""
        pairs = {
            f"{pair.link.a}~{pair.link.b}": {
                "apart_deg": round(degrees(pair.apart), 2),
                "limit_deg": round(degrees(pair.limit), 2),
                "doubtful": pair.doubtful,
            }
            for pairs in self._pairs
            for pair in pairs
        }
        headings = {
            self._chain.joints[i + 1]: {
                "drift_deg": round(degrees(joint.drift.heading), 2) if joint.links else None,
                "sd_deg": round(degrees(joint.drift.sd), 2) if joint.links else None,
            }
            for i, joint in enumerate(self._joints)
        }
        return {"pairs": pairs, "headings": headings}


def _standing(calibration: Calibration, above: str, below: str) -> float:
    segment = calibration.segment
    return axis_heading_one(segment[above].q_static, segment[below].q_static) or 0.0


def _turned_back(back: tuple[float, float], q: Quaternion) -> Quaternion:
    """Return the orientation in a world turned about the vertical."""
    c, s = back
    w, x, y, z = q
    return (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)


def _wrapped(angle: float) -> float:
    turn = 6.283185307179586
    return angle - turn * round(angle / turn)


def _told(pair: PairWatch, segment: str) -> SensorNews:
    a, b = pair.link.a, pair.link.b
    data = {"pair": [a, b], "apart_deg": round(degrees(pair.apart), 1)}
    if not pair.doubtful:
        text = f"{a} and {b} lie as calibration had them again"
        return SensorNews(segment, "agrees", text, "info", data)
    text = (
        f"{a} and {b} lie {degrees(pair.apart):.0f} deg from where calibration had them: one of "
        "them slipped; set it right, stand still and take a new static pose"
    )
    return SensorNews(segment, "pair_disagrees", text, "warning", data)
