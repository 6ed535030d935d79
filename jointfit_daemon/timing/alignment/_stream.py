"""One stream of the frame aligner, with its pending samples, usual delay and counters.

Memory is bounded, and streams are independent of each other. A sample is stored while a frame may
still need it. At most three samples at or before the last frame are stored for extrapolation. The
outcome of a sample is counted when it is removed.
"""

from __future__ import annotations

from collections import deque
from enum import StrEnum
from typing import TYPE_CHECKING

from jointfit_daemon.timing.alignment import _interpolation

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector

CAPACITY = 512
"""Largest number of pending samples."""
PATIENCE = 1.45
"""Periods to wait for a sample beyond its usual delay. The delay estimate varies from
sample to sample; with this variation, the wait stays below 1.5 periods.
"""
REACH = 2.5
"""Largest extrapolation after the last sample, periods."""
GAP = 4.0
"""Largest interval between two samples for interpolation, periods."""
CROWDED = 0.5
"""Least interval between two samples from which a rate is computed, periods. Timestamps may be
close together while a clock settles.
"""
LOST_PERIODS = 3
"""Silence after which a stream counts as lost, periods; at least `LOST_LEAST_NS`."""
LOST_LEAST_NS = 50_000_000
"""Least silence after which a stream counts as lost, ns."""
FUTURE_NS = 100_000_000
"""Largest time by which a valid timestamp may be later than the arrival of the sample, ns."""
PAST_NS = 10_000_000_000
"""Largest time from sampling to arrival of a sample for live use, ns. Older samples are late."""
DELAY_MOST_NS = 250_000_000
"""Largest delay that frames wait for, ns."""

_EARLY = 20
"""The deadline of a frame is computed from the first sample whose expected instant is after the
frame, or at most 1/20 period before the frame. With jitter, the real instant of such a sample may
be after the frame.
"""
_DELAY_STEP = 128
"""The usual delay decreases by at most 1/128 period per sample."""
_DELAY_UP = 3
"""Ratio of the largest increase to the largest decrease of the usual delay. With the ratio 3 the
usual delay converges to the 75th percentile of the delays.
"""
_BEHIND = 3
"""Number of samples at or before a frame that extrapolation needs."""


class SampleOutcome(StrEnum):
    """Outcome of a sample."""

    USED = "used"
    """Used in at least one frame."""
    DECIMATED = "decimated"
    """Skipped, because the stream is faster than the frames."""
    LATE = "late"
    """Sample that arrived after the emission of all frames that needed this sample."""
    DUPLICATE = "duplicate"
    """Sample with the same time as another sample."""
    DROPPED = "dropped"
    """Sample discarded because of overflow, reset, close, or a timestamp in the future."""
    IDLE = "idle"
    """Mocap frame that no calibration phase records, and from which the position of the first joint
    is not computed. A sample of a stream never has this outcome.
    """


class _Sample:
    __slots__ = ("arrival_ns", "late", "q", "rate", "synced", "t_ns", "turn", "used")

    def __init__(
        self, t_ns: int, arrival_ns: int, q: Quaternion, rate: Vector | None, synced: bool
    ) -> None:
        self.t_ns, self.arrival_ns, self.q, self.rate = t_ns, arrival_ns, q, rate
        self.synced = synced
        self.late = self.used = False
        self.turn: Vector | None = None


class Stream:
    """Samples of one stream between their arrival and their outcome."""

    __slots__ = (
        "_counts", "_crowded_ns", "_delay_ns", "_delay_step", "_gap_ns",
        "_lost_after_ns", "_patience_ns", "_reach_ns", "_received", "_samples",
        "epoch", "extrapolated", "newest_arrival_ns", "newest_ns", "period_ns",
        "synced", "waited_for",
    )  # fmt: skip

    def __init__(self, period_ns: int) -> None:
        period = self.period_ns = period_ns
        self._patience_ns = round(PATIENCE * period)
        self._reach_ns = round(REACH * period)
        self._gap_ns = round(GAP * period)
        self._crowded_ns = round(CROWDED * period)
        self._lost_after_ns = max(LOST_PERIODS * period, LOST_LEAST_NS)
        self._delay_step = max(1, period // _DELAY_STEP)
        self._delay_ns: int | None = None  # usual arrival time minus timestamp
        self._samples: deque[_Sample] = deque()
        self.epoch: int | None = None
        """Epoch of the clock of the samples."""
        self.waited_for = False
        """Whether more samples are expected."""
        self._received = 0
        self._counts = dict.fromkeys(SampleOutcome, 0)
        self.newest_ns = self.newest_arrival_ns = 0
        self.extrapolated = self.synced = False
        """Whether the last result of ``at`` was extrapolated, and whether the clock had settled for
        all samples of this result.
        """

    # --- samples -----------------------------------------------------------------------------

    def push(
        self,
        t_ns: int,
        arrival_ns: int,
        q: Quaternion,
        *,
        synced: bool,
        epoch: int,
        passed_ns: int | None,
        rate: Vector | None = None,
    ) -> SampleOutcome | None:
        """Add a sample; return its outcome if it is already known.

        `passed_ns` is the instant of the last emitted frame, ns; None before the first frame. The
        other parameters are described at `FrameAligner.push`.
        """
        self._received += 1
        if t_ns > arrival_ns + FUTURE_NS:
            return self._count(SampleOutcome.DROPPED)
        if t_ns < arrival_ns - PAST_NS:
            return self._count(SampleOutcome.LATE)
        if epoch != self.epoch:
            self.reset()
            self.epoch = epoch
        samples = self._samples
        sample = _Sample(t_ns, arrival_ns, q, rate, synced)
        sample.late = passed_ns is not None and t_ns <= passed_ns
        if samples and t_ns <= samples[-1].t_ns:
            return self._insert(sample)

        delay_ns, usual_ns = arrival_ns - t_ns, self._delay_ns
        if usual_ns is not None:
            least, most = usual_ns - self._delay_step, usual_ns + _DELAY_UP * self._delay_step
            delay_ns = least if delay_ns < least else min(delay_ns, most)
        self._delay_ns = delay_ns
        samples.append(sample)
        self.newest_ns, self.waited_for = t_ns, True
        if arrival_ns > self.newest_arrival_ns:  # noqa: PLR1730 - max() takes longer
            self.newest_arrival_ns = arrival_ns
        if len(samples) > CAPACITY:
            self._leave(samples.popleft(), SampleOutcome.DROPPED)
        return None

    def _insert(self, sample: _Sample) -> SampleOutcome | None:
        """Insert a reordered sample if a later frame may still need it.

        Otherwise, return the outcome of the sample.
        """
        samples = self._samples
        at = len(samples)
        while at and samples[at - 1].t_ns > sample.t_ns:
            at -= 1
        if at and samples[at - 1].t_ns == sample.t_ns:
            return self._count(SampleOutcome.DUPLICATE)
        if sample.late or at == 0 or len(samples) >= CAPACITY:
            return self._count(SampleOutcome.LATE)
        samples[at].turn = None
        samples.insert(at, sample)
        return None

    # --- frames ------------------------------------------------------------------------------

    def serves_from(self, t_ns: int | None) -> int | None:
        """Return the first instant at or after `t_ns` for which this stream has data, or None."""
        samples = self._samples
        if not samples:
            return None
        if t_ns is None:
            return samples[0].t_ns
        before = None
        for sample in samples:
            if sample.t_ns >= t_ns:
                close = before is not None and sample.t_ns - before.t_ns <= self._gap_ns
                return t_ns if close else self._time_in_reach(before, t_ns) or sample.t_ns
            before = sample
        return self._time_in_reach(before, t_ns)

    def _time_in_reach(self, before: _Sample | None, t_ns: int) -> int | None:
        return t_ns if before is not None and t_ns - before.t_ns <= self._reach_ns else None

    def due(self, t_ns: int) -> int:
        """Return the arrival of the first sample at or after `t_ns`, ns.

        If this sample has not arrived, return the deadline of the stream for the frame at `t_ns`.
        If no more samples are expected, return `t_ns`.
        """
        if not self.waited_for:
            return t_ns  # no frame is published before its instant
        newest = self.newest_ns
        if newest < t_ns:
            period = self.period_ns
            expected = newest - (newest + period // _EARLY - t_ns) // period * period
            deadline = expected + min(self._delay_ns or 0, DELAY_MOST_NS) + self._patience_ns
            return min(deadline, self.newest_arrival_ns + self._lost_after_ns)
        for sample in self._samples:
            if sample.t_ns >= t_ns:
                return sample.arrival_ns
        return 0

    def latest_wait_ns(self, t_ns: int) -> int:
        """Return the host time until which a frame without samples waits for this stream, ns.

        The frame has the instant `t_ns`. It waits for the usual delay of the stream, at most
        `DELAY_MOST_NS`. While more samples are expected, it waits at least until the stream counts
        as lost.
        """
        if self.newest_ns >= t_ns:
            return t_ns
        delay_ns = self._delay_ns or 0
        usual_ns = t_ns + min(delay_ns, DELAY_MOST_NS) + self._patience_ns
        if not self.waited_for:
            return usual_ns
        return max(usual_ns, min(t_ns + delay_ns, self.newest_arrival_ns) + self._lost_after_ns)

    def at(self, t_ns: int) -> Quaternion | None:
        """Return the orientation at `t_ns`, or None without data; `t_ns` must not decrease."""
        self.extrapolated = False
        samples = self._samples

        after = len(samples)  # index of the first sample after `t_ns`
        while after and samples[after - 1].t_ns > t_ns:
            after -= 1
        if not after:
            return None
        while after > _BEHIND:
            self._leave(samples.popleft(), SampleOutcome.DECIMATED)
            after -= 1

        last = after - 1
        a = samples[last]
        if a.t_ns == t_ns:
            a.used, self.synced = True, a.synced
            return a.q
        if after < len(samples):
            b = samples[after]
            if b.t_ns - a.t_ns <= self._gap_ns:
                before = self._before(last)
                a.used = b.used = True
                self.synced = a.synced and b.synced
                if before is not None and before.synced is a.synced:
                    before.used = True
                else:
                    before = None
                return _interpolation.interpolate_orientation(before, a, b, t_ns)
        if t_ns - a.t_ns > self._reach_ns:
            return None
        return self._beyond(last, t_ns)

    def _before(self, at: int) -> _Sample | None:
        """Return the sample before index `at`, or None.

        The result is None if the interval to the sample at this index is too short or too long to
        compute a rate.
        """
        if not at:
            return None
        before = self._samples[at - 1]
        apart_ns = self._samples[at].t_ns - before.t_ns
        return before if self._crowded_ns <= apart_ns <= self._gap_ns else None

    def _beyond(self, last: int, t_ns: int) -> Quaternion | None:
        before = self._before(last)
        if before is None:
            return None
        a, earlier = self._samples[last], self._before(last - 1)
        a.used = before.used = self.extrapolated = True
        self.synced = a.synced and before.synced
        if earlier is not None and earlier.synced is before.synced:
            earlier.used = True
        else:
            earlier = None
        return _interpolation.extrapolate_orientation(earlier, before, a, t_ns)

    # --- end ---------------------------------------------------------------------------------

    def lose(self) -> None:
        """Stop waiting for this stream until its next sample."""
        self.waited_for = False

    def settle(self) -> None:
        """Discard the samples if the stream has ended, because no frame can use them."""
        if self._samples and not self.waited_for:
            self.reset()

    def reset(self) -> None:
        """Discard all samples; samples that no frame used count as dropped."""
        samples = self._samples
        while samples:
            self._leave(samples.popleft(), SampleOutcome.DROPPED)
        self.waited_for, self.epoch = False, None

    def counts(self) -> dict[str, int]:
        """Return the number of received samples, of samples by outcome, and of pending samples."""
        outcomes = {outcome.value: count for outcome, count in self._counts.items()}
        return {"received": self._received, **outcomes, "pending": len(self._samples)}

    def _leave(self, sample: _Sample, otherwise: SampleOutcome) -> None:
        if sample.used:
            self._count(SampleOutcome.USED)
        elif sample.late and otherwise is SampleOutcome.DECIMATED:
            self._count(SampleOutcome.LATE)
        else:
            self._count(otherwise)

    def _count(self, outcome: SampleOutcome) -> SampleOutcome:
        self._counts[outcome] += 1
        return outcome
