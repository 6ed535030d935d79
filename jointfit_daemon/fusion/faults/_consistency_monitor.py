"""Consistency of the sensors of a limb: slip, magnetic disturbance and heading drift.

Twenty-five times a second the monitor compares pairs of sensors. A *link* of the calibration
predicts the relation of a pair. The pairs are:

* pairs on one segment (:mod:`jointfit_daemon.fusion.faults._slip`),
* pairs across a hinge (:mod:`jointfit_daemon.fusion.faults._joint_heading`).

A deviation from the predicted relation that appears within seconds is a slip, or a magnetic
disturbance if it is a rotation about the vertical. A deviation about the vertical that grows over
minutes is heading drift. Heading errors are removed from the sensors before fusion. Only
differences of headings are observable. The drifts of the segments are therefore defined to have the
mean 0. The drifts of the sensors of a segment, relative to the segment, also have the mean 0.

If the deviation of a pair is larger than soft tissue can cause, the soft-tissue model does not
apply. Both sensors are then rotated towards each other by equal angles until the deviation has its
usual size.

Invariant: the cost per frame is O(1).
"""

from __future__ import annotations

from itertools import combinations
from math import cos, degrees, hypot, radians, sin, sqrt, tau
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.fusion.faults._fault_reports import drift_report, heading_report, slip_report
from jointfit_daemon.fusion.faults._heading_drift import HeadingDriftFilter
from jointfit_daemon.fusion.faults._joint_heading import JointHeadingMonitor
from jointfit_daemon.fusion.faults._magnetic_disturbance import (
    HeadingDifference,
    MagneticDisturbanceDetector,
)
from jointfit_daemon.fusion.faults._slip import SlipDetector, pair_corrections, untrained_link
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.limb_model import axis_heading_one, inner_joints, up_one
from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from jointfit_daemon.fusion.faults._sensor_monitor import SensorReport
    from jointfit_daemon.limb_model import Calibration, InnerJoint, SensorLink
    from jointfit_daemon.model import Chain, Quaternion, Vector

    Inputs = dict[str, Quaternion]

UPDATE_NS = 39_000_000
"""Interval of the comparisons, ns. With frames at 100 Hz it results in 25 comparisons per second.
"""
SUDDEN_SD = radians(2.0)
"""Change of a segment's standard deviation between two comparisons, rad. After a larger change the
next frame is compared as well, so that one wrong sample affects one frame instead of a whole
interval.
"""
MIN_DRIFT = radians(0.2)
"""Smallest heading drift that is corrected, rad."""
REPORTED_DRIFT = radians(5.0)
"""Heading drift that is reported, rad."""
MAJORITY = 3
"""Smallest number of sensors on a segment with which the slipped sensor can be identified."""
MOST_PAIRED = 5
"""Largest number of sensors on a segment for which every pair is compared. The number of pairs
grows with the square of the number of sensors.
"""


def compared_pairs(group: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of sensors of one segment that are compared, in the order of `group`.

    If a segment has more than `MOST_PAIRED` sensors, the first is compared with all others. The
    others form a ring, and each of them is also compared with its two neighbors in this ring. Every
    sensor is then in at least three pairs. A single slipped sensor is therefore the only sensor
    whose pairs are all inconsistent, even if another sensor is lost.
    """
    pairs, last = combinations(range(len(group)), 2), len(group) - 1
    return [
        (group[i], group[k])
        for i, k in pairs
        if len(group) <= MOST_PAIRED or i == 0 or k == i + 1 or (i, k) == (1, last)
    ]


class ConsistencyResult(NamedTuple):
    """Result of the comparisons of one frame."""

    spread: tuple[float, ...]
    """Standard deviation per axis that is added to each segment, rad."""
    slipped: frozenset[str]
    """Sensors that contradict all others of their segment and are excluded from fusion."""
    flags: tuple[str, ...]


class ConsistencyMonitor:
    """Compares the sensors of one calibrated limb with each other.

    Parameters
    ----------
    chain : Chain
        Sensors by segment.
    calibration : Calibration
        Calibration with the links between sensors.
    drifting : collection of str
        Sensors without heading reference. If no hinge makes their headings observable, the standard
        deviation of the heading grows without limit. For other sensors the drift is assumed to be
        bounded.
    """

    def __init__(
        self, chain: Chain, calibration: Calibration, drifting: Collection[str] = ()
    ) -> None:
        self._chain = chain
        links = {(link.a, link.b): link for link in calibration.links}
        couples = [compared_pairs(group) for group in chain.sensors]
        self._pairs = [
            [SlipDetector(links.get(pair) or untrained_link(*pair)) for pair in pairs]
            for pairs in couples
        ]
        self._pair_drifts = {
            pair: HeadingDriftFilter(links[pair].spread)
            for pairs in couples
            for pair in pairs
            if pair in links
        }
        self._inner = inner_joints(chain)
        self._joints = [
            _joint_monitor(chain, joint, calibration, links, drifting) for joint in self._inner
        ]

        drifts = any(name in drifting for group in chain.sensors for name in group)
        self._common = HeadingDriftFilter(0.0) if drifts else None
        self._drifts = [*self._pair_drifts.values(), *(joint.drift for joint in self._joints)]
        if self._common is not None:
            self._drifts.append(self._common)
        self._sensor_drift: dict[str, float] = dict.fromkeys(calibration.sensor, 0.0)
        """Heading drift that is removed from each sensor, rad."""
        self._segment_drift = [0.0] * len(chain.segments)
        """Part of the heading drift that is common to all sensors of a segment, rad."""
        self._half_turns: dict[str, tuple[float, float]] = {}
        """cos and sin of half the heading correction, by corrected sensor."""
        self._disturbances = MagneticDisturbanceDetector(chain.sensors)
        self._preceding = {n: group[:k] for group in chain.sensors for k, n in enumerate(group)}
        """Sensors that are listed before each sensor of the same segment."""
        self._corrections: dict[str, Quaternion] = {}
        """Rotation applied to each sensor, in segment axes, which reduces the deviations of its
        pairs."""
        self._consistent = [True] * len(chain.segments)
        """Whether all pairs of each segment are consistent."""
        self._all_consistent = True
        self._next_ns = 0
        self._no_fault = ConsistencyResult((0.0,) * len(chain.segments), frozenset(), ())
        self._result = self._no_fault
        self._reports: list[SensorReport] = []
        self._reported_drifts: set[int] = set()

    # --- every frame -------------------------------------------------------------------------

    def correct_headings(self, inputs: Inputs) -> Inputs:
        """Return the orientations without heading drift and magnetic disturbances."""
        if not self._half_turns:
            return inputs
        corrected = inputs.copy()
        for name, (c, s) in self._half_turns.items():
            if name in inputs:
                w, x, y, z = inputs[name]
                corrected[name] = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
        return corrected

    def correct_pairs(self, inputs: Inputs) -> Inputs:
        """Return the orientations with limited deviations of the pairs; call after ``update``."""
        if not self._corrections:
            return inputs
        corrected = inputs.copy()
        for name, turn in self._corrections.items():
            if name in inputs:
                corrected[name] = multiply_one(inputs[name], turn)
        return corrected

    def update(self, t_ns: int, inputs: Inputs) -> ConsistencyResult:
        """Compare the sensors if the interval has passed; return the latest result.

        Parameters
        ----------
        t_ns : int
            Instant of the frame.
        inputs : dict
            q_optical_segment by sensor, with corrected headings.
        """
        if t_ns < self._next_ns and self._next_ns - t_ns <= UPDATE_NS:
            return self._result
        self._next_ns = t_ns + UPDATE_NS

        verticals = {name: up_one(q) for name, q in inputs.items()}
        differences = self._compare_pairs(t_ns, inputs, verticals)
        for i in range(len(self._joints)):
            differences += self._compare_joint(t_ns, i, inputs, verticals)
        changed = self._disturbances.update(t_ns, differences)
        self._report_pairs()

        if any([drift.step(t_ns) for drift in self._drifts]):  # noqa: C419 - every filter is stepped
            self._distribute_drifts()
            self._report_drifts()
            changed = True

        if changed:
            disturbances = self._disturbances.corrections
            self._half_turns = {}
            for name, drift in self._sensor_drift.items():
                turn = drift + disturbances.get(name, 0.0)
                if turn:
                    self._half_turns[name] = (cos(0.5 * turn), -sin(0.5 * turn))

        before, self._result = self._result, self._evaluate(inputs)
        if self._result is not before:
            changes = zip(self._result.spread, before.spread, strict=True)
            if any(abs(new - old) > SUDDEN_SD for new, old in changes):
                self._next_ns = t_ns
        return self._result

    def _compare_pairs(
        self, t_ns: int, inputs: Inputs, verticals: Mapping[str, Vector]
    ) -> list[HeadingDifference]:
        differences: list[HeadingDifference] = []
        for pairs in self._pairs:
            for pair in pairs:
                differences += self._compare_pair(t_ns, pair, inputs, verticals)

        self._all_consistent = True
        for k, pairs in enumerate(self._pairs):
            self._consistent[k] = True
            for pair in pairs:
                if not pair.consistent:
                    self._consistent[k] = self._all_consistent = False
        return differences

    def _compare_pair(
        self, t_ns: int, pair: SlipDetector, inputs: Inputs, verticals: Mapping[str, Vector]
    ) -> tuple[HeadingDifference, ...]:
        link = pair.link
        a, b = inputs.get(link.a), inputs.get(link.b)
        if a is None or b is None:
            pair.clear_excess()
            return ()

        # The posture from a slipped sensor of the neighboring segment would make this pair appear
        # inconsistent as well.
        near = None
        for neighbor in link.near:
            if neighbor in verticals:
                near = None if self._is_tilted(neighbor) else verticals[neighbor]
                break
        correction = self._heading_correction(link.a, link.b)
        pair.update(t_ns, a, b, (verticals[link.a], near), correction=correction)

        drift = self._pair_drifts.get((link.a, link.b))
        if drift is None or pair.tilted:
            return ()
        if pair.consistent and near is not None:
            drift.add_measurement(
                pair.heading + self._sensor_drift[link.b] - self._sensor_drift[link.a]
            )
        # The differences must form a graph without cycles, so only the pairs of the first sensor
        # with data are used.
        for name in self._preceding[link.a]:
            if name in inputs:
                return ()
        return (HeadingDifference(link.a, link.b, pair.heading, link.spread),)

    def _compare_joint(
        self, t_ns: int, i: int, inputs: Inputs, verticals: Mapping[str, Vector]
    ) -> list[HeadingDifference]:
        joint, differences = self._joints[i], list[HeadingDifference]()
        above, below = self._inner[i].proximal, self._inner[i].distal
        consistent = self._consistent[above] and self._consistent[below]
        for link in joint.links:
            if link.a not in inputs or link.b not in inputs or self._is_tilted(link.a, link.b):
                continue
            heading = axis_heading_one(inputs[link.a], inputs[link.b])
            if heading is None:
                continue
            (expected,), sd = link.predict(verticals[link.a], verticals[link.b])
            residual = heading - joint.standing - expected
            residual -= tau * round(residual / tau)
            differences.append(HeadingDifference(link.a, link.b, residual, sd))
            if consistent:  # if the sensors of each segment agree, one link is sufficient
                break
        if not differences:
            return []

        a, b, residual, sd = differences[0]
        best = min((d.angle + self._heading_correction(d.a, d.b) for d in differences), key=abs)
        if joint.update(t_ns, residual, best, sd):
            proximal, distal = self._chain.segments[above], self._chain.segments[below]
            self._reports.append(
                heading_report(joint.difference, proximal, distal, inconsistent=joint.inconsistent)
            )

        uncorrected = residual + self._heading_correction(a, b)
        if consistent and not joint.inconsistent:
            joint.drift.add_measurement(
                uncorrected + self._segment_drift[below] - self._segment_drift[above]
            )
        return [HeadingDifference(a, b, uncorrected, sd)]

    def _heading_correction(self, a: str, b: str) -> float:
        """Return the correction of magnetic disturbances of sensor b relative to sensor a, rad."""
        corrections = self._disturbances.corrections
        return corrections.get(b, 0.0) - corrections.get(a, 0.0) if corrections else 0.0

    def _is_tilted(self, *sensors: str) -> bool:
        """Return whether one of the sensors belongs to a pair with a deviation beyond heading.

        `SlipDetector.tilted` defines such a deviation.
        """
        return not self._all_consistent and any(
            pair.tilted and (pair.link.a in sensors or pair.link.b in sensors)
            for consistent, pairs in zip(self._consistent, self._pairs, strict=True)
            if not consistent
            for pair in pairs
        )

    def _report_pairs(self) -> None:
        for segment, pairs in zip(self._chain.segments, self._pairs, strict=True):
            for pair in pairs:
                if pair.changed:
                    pair.changed = False
                    outlier = self._disturbances.outlier(pair.link.a, pair.link.b)
                    disturbed = None if pair.tilted else outlier
                    self._reports.append(slip_report(pair, segment, disturbed))

    # --- heading drift, once a second --------------------------------------------------------

    def _distribute_drifts(self) -> None:
        """Compute the drift of each sensor from the drifts of pairs and joints, with mean 0."""
        along = [0.0]
        for inner, joint in zip(self._inner, self._joints, strict=True):
            along.append(along[inner.proximal] + (joint.drift.heading if joint.links else 0.0))
        middle = sum(along) / len(along)
        self._segment_drift = [drift - middle for drift in along]

        for i, group in enumerate(self._chain.sensors):
            own = [0.0, *(self._pair_drift(group[0], name) for name in group[1:])]
            center = sum(own) / len(own)
            for name, drift in zip(group, own, strict=True):
                self._sensor_drift[name] = self._segment_drift[i] + drift - center

        largest = max((abs(drift) for drift in self._sensor_drift.values()), default=0.0)
        if largest <= MIN_DRIFT:
            self._sensor_drift = dict.fromkeys(self._sensor_drift, 0.0)
            self._segment_drift = [0.0] * len(self._segment_drift)

    def _pair_drift(self, first: str, name: str) -> float:
        drift = self._pair_drifts.get((first, name))
        return 0.0 if drift is None else drift.heading

    def _report_drifts(self) -> None:
        for i, joint in enumerate(self._joints):
            size = abs(joint.drift.heading)
            if i in self._reported_drifts and size < 0.5 * REPORTED_DRIFT:
                self._reported_drifts.discard(i)
            elif i not in self._reported_drifts and joint.links and size > REPORTED_DRIFT:
                self._reported_drifts.add(i)
                _, name, above, below = self._inner[i]
                proximal, distal = self._chain.segments[above], self._chain.segments[below]
                self._reports.append(drift_report(joint.drift.heading, proximal, distal, name))

    # --- result ------------------------------------------------------------------------------

    def _evaluate(self, inputs: Inputs) -> ConsistencyResult:
        spread, slipped, flags = self._evaluate_pairs(inputs)
        for inner, joint in zip(self._inner, self._joints, strict=True):
            variance = joint.extra_variance / 3.0  # a heading error is about one of three axes
            if variance:
                for k in (inner.proximal, inner.distal):
                    spread[k] = sqrt(spread[k] * spread[k] + variance)
            if joint.inconsistent:
                flags.append(FrameFlag.HEADING_DISAGREES.of(inner.name))
        if self._common is not None and self._common.sd > REPORTED_DRIFT:
            flags.append(FrameFlag.HEADING_UNSEEN)

        if not slipped and not flags and not any(spread):
            return self._no_fault
        return ConsistencyResult(tuple(spread), frozenset(slipped), tuple(flags))

    def _evaluate_pairs(self, inputs: Inputs) -> tuple[list[float], set[str], list[str]]:
        spread, slipped, flags = [], set[str](), []
        self._corrections = {}
        for i, pairs in enumerate(self._pairs):
            outlier = None if self._consistent[i] else self._slipped_sensor(i, inputs)
            if outlier is not None:
                slipped.add(outlier)
                flags.append(FrameFlag.SLIPPED.of(outlier))
            elif not self._consistent[i] and any(pair.inconsistent for pair in pairs):
                flags.append(FrameFlag.PAIR_DISAGREES.of(self._chain.segments[i]))

            remaining = pairs
            if outlier is not None:
                remaining = [p for p in pairs if outlier not in (p.link.a, p.link.b)]
            excess = max([pair.excess for pair in remaining], default=0.0)
            spread.append(excess / sqrt(3.0))
            if excess and any(pair.exceeded for pair in remaining):
                self._corrections |= pair_corrections(remaining)
        return spread, slipped, flags

    def _slipped_sensor(self, i: int, inputs: Inputs) -> str | None:
        """Return the sensor that contradicts all other sensors of its segment, or None.

        The other sensors must agree with each other.
        """
        group = self._chain.sensors[i]
        present = [name for name in group if name in inputs] if len(group) >= MAJORITY else []
        if len(present) < MAJORITY:
            return None
        inconsistent = [
            (pair.link.a, pair.link.b)
            for pair in self._pairs[i]
            if pair.inconsistent and pair.link.a in present and pair.link.b in present
        ]
        for name in present:
            own = sum(
                name in (pair.link.a, pair.link.b)
                and pair.link.a in present
                and pair.link.b in present
                for pair in self._pairs[i]
            )
            if own > 1 and len(inconsistent) == own and all(name in p for p in inconsistent):
                return name
        return None

    @property
    def common_heading_sd(self) -> float:
        """Standard deviation of the unobservable heading error that all segments share, rad."""
        unobserved = 0.0 if self._common is None else self._common.sd
        return hypot(unobserved, self._disturbances.ambiguity)

    # --- reports -----------------------------------------------------------------------------

    def pop_reports(self) -> list[SensorReport]:
        """Return the reports since the last call."""
        if not self._reports:
            return []
        reports, self._reports = self._reports, []
        return reports

    def health(self) -> dict[str, object]:
        """Return pair distances and heading drifts as JSON values, for ``bridge/health``."""
        pairs = {
            f"{pair.link.a}~{pair.link.b}": {
                "apart_deg": round(degrees(pair.distance), 2),
                "limit_deg": round(degrees(pair.limit), 2),
                "doubtful": pair.inconsistent,
            }
            for pairs in self._pairs
            for pair in pairs
        }
        headings = {
            inner.name: {
                "drift_deg": round(degrees(joint.drift.heading), 2) if joint.links else None,
                "sd_deg": round(degrees(joint.drift.sd), 2) if joint.links else None,
            }
            for inner, joint in zip(self._inner, self._joints, strict=True)
        }
        return {"pairs": pairs, "headings": headings}


def _joint_monitor(
    chain: Chain,
    joint: InnerJoint,
    calibration: Calibration,
    links: Mapping[tuple[str, str], SensorLink],
    drifting: Collection[str],
) -> JointHeadingMonitor:
    ends = (joint.proximal, joint.distal)
    above, below = (chain.sensors[k] for k in ends)
    standing = axis_heading_one(*(calibration.segment[chain.segments[k]].q_static for k in ends))
    return JointHeadingMonitor(
        [links[a, b] for a in above for b in below if (a, b) in links],
        standing or 0.0,
        drifts=any(name in drifting for name in (*above, *below)),
    )
