"""Delay percentiles and sample rate of the last minute.

Memory and time per sample are constant. Two half-minute histograms alternate. Results combine the
current and the preceding histogram. Bins are an eighth of an octave wide, so percentiles are
accurate to 5 %. The maximum is exact.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_daemon.units import NS_PER_S

HALF_NS = 30_000_000_000
"""Length of one histogram, ns."""

_UNIT_BITS = 10
"""Binary logarithm of the finest step, which is 2**10 ns, about a microsecond."""
_SUB_BITS = 3
"""Binary logarithm of the number of bins per octave: eight bins."""
_SUBS = 1 << _SUB_BITS
_BINS = (40 - _UNIT_BITS) * _SUBS
_LINEAR = 2 * _SUBS


class DelayPercentiles(NamedTuple):
    """Delays from sampling instant to arrival, ns."""

    p50_ns: float
    p99_ns: float
    max_ns: int


class _Half:
    __slots__ = ("bins", "count", "first_ns", "last_ns", "worst")

    def __init__(self) -> None:
        self.bins = [0] * _BINS
        self.count = self.first_ns = self.last_ns = self.worst = 0


class DelayStatistics:
    """Arrivals and delays of one source in the last 30 s to 60 s."""

    __slots__ = ("_before", "_end_ns", "_now")

    def __init__(self) -> None:
        self._before, self._now = _Half(), _Half()
        self._end_ns: int | None = None

    def feed(self, arrival_ns: int, delay_ns: int) -> None:
        """Count one sample; negative delays count as 0."""
        end = self._end_ns
        if end is None or arrival_ns >= end:
            idle = end is None or arrival_ns >= end + HALF_NS
            self._before = _Half() if idle else self._now
            self._now, self._end_ns = _Half(), arrival_ns + HALF_NS

        half = self._now
        if half.count == 0:
            half.first_ns = arrival_ns
        half.count += 1
        half.last_ns = arrival_ns
        if delay_ns > half.worst:  # noqa: PLR1730 - max() takes longer than the rest of the method
            half.worst = delay_ns
        half.bins[bin_of(delay_ns)] += 1

    @property
    def rate_hz(self) -> float | None:
        """Mean arrival rate, Hz, pauses included; None with fewer than two samples."""
        before, now = self._before, self._now
        count = before.count + now.count
        first = before.first_ns if before.count else now.first_ns
        if count <= 1 or now.last_ns <= first:
            return None
        return (count - 1) * NS_PER_S / (now.last_ns - first)

    @property
    def delays(self) -> DelayPercentiles | None:
        """Percentiles of the delays; None before the first sample."""
        before, now = self._before, self._now
        count = before.count + now.count
        if not count:
            return None

        bins = [a + b for a, b in zip(before.bins, now.bins, strict=True)]
        worst = max(before.worst, now.worst)
        p50, p99 = (min(_height(bins, share * count), float(worst)) for share in (0.5, 0.99))
        return DelayPercentiles(p50, p99, worst)


def bin_of(delay_ns: int) -> int:
    """Return the bin of a delay.

    Bins are linear up to 16 units of 1024 ns; above, there are eight per octave.
    """
    units = delay_ns >> _UNIT_BITS if delay_ns > 0 else 0
    if units < _LINEAR:
        return units

    octave = units.bit_length() - _SUB_BITS - 1
    return min((octave << _SUB_BITS) + (units >> octave), _BINS - 1)


def _height(bins: list[int], rank: float) -> float:
    """Return the delay, ns, at a rank of the histogram, interpolated within the bin."""
    below = 0
    for index, count in enumerate(bins):
        if count and below + count >= rank:
            low, high = _edge(index), _edge(index + 1)
            return low + (high - low) * (rank - below) / count
        below += count
    return 0.0


def _edge(index: int) -> float:
    """Return the lower edge of a bin, ns."""
    octave = max(0, (index >> _SUB_BITS) - 1)
    return float((index - (octave << _SUB_BITS)) << octave << _UNIT_BITS)
