"""Sensors against each other: who slipped, and whose heading drifts.

Law: pure, O(1) a frame; looks at the links that calibration learnt, 25 times a second.

A difference that comes within seconds is a slip, or iron nearby if it turns about the vertical; one
that takes minutes and does is drift. Turns about the vertical are taken out of the sensors before
anything else looks at them. Only differences can be seen: what all sensors have in common is left
alone, so the drifts of the segments, and of the sensors of each, have the mean 0.

A pair that lies further apart than skin moves it is brought together as far as that, either sensor
by the same: what calibration learnt of skin says nothing of a sensor that slipped.
"""

from __future__ import annotations

from itertools import combinations
from math import cos, degrees, hypot, radians, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.fusion.faults._fault_reports import drift_told, pair_told, turn_told
from jointfit_daemon.fusion.faults._heading_drift import HeadingDrift
from jointfit_daemon.fusion.faults._joint_heading import JointWatch
from jointfit_daemon.fusion.faults._magnetic_disturbance import Look, SuddenTurns
from jointfit_daemon.fusion.faults._slip import PairWatch, together, untrained
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.limb_model import axis_heading_one, up_one

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from jointfit_daemon.fusion.faults._sensor_monitor import SensorNews
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, Quaternion, Vector

    Inputs = dict[str, Quaternion]

LOOK_NS = 39_000_000
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
            JointWatch(
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
        self._backs: dict[str, tuple[float, float]] = {}
        """cos and sin of half the turn back, of sensors that are corrected."""
        self._sudden = SuddenTurns(chain.sensors)
        self._before = {name: group[:k] for group in chain.sensors for k, name in enumerate(group)}
        """Sensors of the same segment that stand before each."""
        self._moves: dict[str, Quaternion] = {}
        """Turns in the segment's axes that bring pairs together."""
        self._quiet = [True] * len(chain.segments)
        """By segment, whether no pair there contradicts itself."""
        self._calm_all = True
        self._next_ns = 0
        self._calm = Doubt((0.0,) * len(chain.segments), frozenset(), ())
        self._doubt = self._calm
        self._news: list[SensorNews] = []
        self._told_drift: set[int] = set()

    # --- every frame -------------------------------------------------------------------------

    def correct(self, inputs: Inputs) -> Inputs:
        """Return the sensors without what is known to be wrong with their headings."""
        if not self._backs:
            return inputs
        return {
            name: q if (back := self._backs.get(name)) is None else _turned_back(back, q)
            for name, q in inputs.items()
        }

    def brought_together(self, inputs: Inputs) -> Inputs:
        """Return the sensors no further apart than skin moves them; ask after ``look``."""
        if not self._moves:
            return inputs
        return {
            name: q if (move := self._moves.get(name)) is None else multiply_one(q, move)
            for name, q in inputs.items()
        }

    def look(self, t_ns: int, inputs: Inputs) -> Doubt:
        """Return what is in doubt; look again if it is time. `inputs` are corrected ones."""
        if t_ns < self._next_ns and self._next_ns - t_ns <= LOOK_NS:
            return self._doubt
        self._next_ns = t_ns + LOOK_NS
        ups = {name: up_one(q) for name, q in inputs.items()}
        looks = self._look_within(t_ns, inputs, ups)
        for i in range(len(self._joints)):
            looks += self._look_at_joint(t_ns, i, inputs, ups)
        turned = self._sudden.look(t_ns, looks)
        self._tell_pairs()
        if self._step(t_ns):
            self._use_headings()
            self._tell_drift()
            turned = True
        if turned:
            self._turn_back()
        self._doubt = self._doubts(inputs)
        return self._doubt

    def _look_within(self, t_ns: int, inputs: Inputs, ups: Mapping[str, Vector]) -> list[Look]:
        looks: list[Look] = []
        for pairs in self._pairs:
            for pair in pairs:
                looks += self._look_at_pair(t_ns, pair, inputs, ups)
        self._calm_all = True
        for k, pairs in enumerate(self._pairs):
            self._quiet[k] = True
            for pair in pairs:
                if not pair.calm:
                    self._quiet[k] = self._calm_all = False
        return looks

    def _look_at_pair(
        self, t_ns: int, pair: PairWatch, inputs: Inputs, ups: Mapping[str, Vector]
    ) -> tuple[Look, ...]:
        link = pair.link
        a, b = inputs.get(link.a), inputs.get(link.b)
        if a is None or b is None:
            pair.silent()
            return ()
        near = None
        for teller in link.near:
            if teller in ups:
                # a posture told by a sensor that slipped would put the blame on this segment, too
                near = None if self._tilted(teller) else ups[teller]
                break
        pair.look(t_ns, a, b, (ups[link.a], near), taken=self._taken(link.a, link.b))
        drift = self._within.get((link.a, link.b))
        if drift is None or pair.tilted:
            return ()
        if pair.calm and near is not None:
            drift.look(pair.turned + self._turns[link.b] - self._turns[link.a])
        for name in self._before[link.a]:  # one way from sensor to sensor is enough
            if name in inputs:
                return ()
        return (Look(link.a, link.b, pair.turned, link.spread),)

    def _look_at_joint(
        self, t_ns: int, i: int, inputs: Inputs, ups: Mapping[str, Vector]
    ) -> list[Look]:
        joint, looks = self._joints[i], list[Look]()
        quiet = self._quiet[i] and self._quiet[i + 1]
        for link in joint.links:
            if link.a not in inputs or link.b not in inputs or self._tilted(link.a, link.b):
                continue
            heading = axis_heading_one(inputs[link.a], inputs[link.b])
            if heading is None:
                continue
            (expected,), sd = link.expected(ups[link.a], ups[link.b])
            left = _wrapped(heading - joint.standing - expected)
            looks.append(Look(link.a, link.b, left, sd))
            if quiet:  # one of them tells what they all do
                break
        if not looks:
            return []
        a, b, left, sd = looks[0]
        best = min((one.turn + self._taken(one.a, one.b) for one in looks), key=abs)
        if joint.look(t_ns, left, best, sd):
            above, below = self._chain.segments[i : i + 2]
            self._news.append(turn_told(joint.apart, above, below, doubtful=joint.doubtful))
        turned = left + self._taken(a, b)
        if quiet and not joint.doubtful:
            joint.drift.look(turned + self._along[i + 1] - self._along[i])
        return [Look(a, b, turned, sd)]

    def _taken(self, a: str, b: str) -> float:
        """Return the sudden turn, b against a, that is taken out of the sensors, rad."""
        taken = self._sudden.taken
        return taken.get(b, 0.0) - taken.get(a, 0.0) if taken else 0.0

    def _tilted(self, *sensors: str) -> bool:
        """Tell whether any of these contradicts its partner in more than heading."""
        return not self._calm_all and any(
            pair.tilted and (pair.link.a in sensors or pair.link.b in sensors)
            for quiet, pairs in zip(self._quiet, self._pairs, strict=True)
            if not quiet
            for pair in pairs
        )

    def _tell_pairs(self) -> None:
        for segment, pairs in zip(self._chain.segments, self._pairs, strict=True):
            for pair in pairs:
                if pair.changed:
                    odd = self._sudden.odd(pair.link.a, pair.link.b)
                    self._news.append(pair_told(pair, segment, None if pair.tilted else odd))
                    pair.changed = False

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
        if max((abs(turn) for turn in self._turns.values()), default=0.0) <= SEEN_DRIFT:
            self._turns = dict.fromkeys(self._turns, 0.0)
            self._along = [0.0] * len(self._along)

    def _turn_back(self) -> None:
        taken = self._sudden.taken
        turns = {name: turn + taken.get(name, 0.0) for name, turn in self._turns.items()}
        self._backs = {
            name: (cos(0.5 * turn), -sin(0.5 * turn)) for name, turn in turns.items() if turn
        }

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
                above, below = self._chain.segments[i : i + 2]
                name = self._chain.joints[i + 1]
                self._news.append(drift_told(joint.drift.heading, above, below, name))

    # --- doubts ------------------------------------------------------------------------------

    def _doubts(self, inputs: Inputs) -> Doubt:
        spread, slipped, flags = self._doubts_within(inputs)
        for i, joint in enumerate(self._joints):
            extra2 = joint.extra2 / 3.0
            if extra2:
                for k in (i, i + 1):
                    spread[k] = sqrt(spread[k] * spread[k] + extra2)
            if joint.doubtful:
                flags.append(f"heading_disagrees:{self._chain.joints[i + 1]}")
        if self._common is not None and self._common.sd > TOLD_DRIFT:
            flags.append("heading_unseen")
        if not slipped and not flags and not any(spread):
            return self._calm
        return Doubt(tuple(spread), frozenset(slipped), tuple(flags))

    def _doubts_within(self, inputs: Inputs) -> tuple[list[float], set[str], list[str]]:
        spread, slipped, flags = [], set[str](), []
        self._moves = {}
        for i, pairs in enumerate(self._pairs):
            odd = None if self._quiet[i] else self._odd_one(i, inputs)
            if odd is not None:
                slipped.add(odd)
                flags.append(f"slipped:{odd}")
            elif not self._quiet[i] and any(pair.doubtful for pair in pairs):
                flags.append(f"pair_disagrees:{self._chain.segments[i]}")
            sure = pairs
            if odd is not None:
                sure = [pair for pair in pairs if odd not in (pair.link.a, pair.link.b)]
            excess = max([pair.excess for pair in sure], default=0.0)
            spread.append(excess / sqrt(3.0))
            if excess and any(pair.apart_too_far for pair in sure):
                self._moves |= together(sure)
        return spread, slipped, flags

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
        unseen = 0.0 if self._common is None else self._common.sd
        return hypot(unseen, self._sudden.unsure)

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
