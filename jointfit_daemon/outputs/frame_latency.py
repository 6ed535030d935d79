"""Latency of frames by processing stage, from the arrival of the last chunk to the broker's socket.

Invariant: a chunk costs one reading of the clock. A frame costs four more readings, one addition to
a histogram per stage, and two small objects.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_UNIT_BITS = 10
"""Number of bits by which times in ns are shifted, so that the unit of the histogram is 1024 ns. A
shift is faster than a division."""
_OCTAVE_BITS = 2
"""Binary logarithm of the number of buckets per octave. With four buckets, the upper limit of a
bucket exceeds the times in it by at most a quarter."""
_BUCKETS = 100
"""Number of buckets. The last bucket contains all times of 60 s and more."""


class LatencyHistogram:
    """Histogram of times with logarithmic buckets, four per octave."""

    def __init__(self) -> None:
        self.counts = [0] * _BUCKETS
        self.total = 0
        self.longest_ns = 0

    def add(self, ns: int) -> None:
        """Count one time, ns; a negative time counts as zero."""
        units = max(0, ns) >> _UNIT_BITS
        shift = max(0, units.bit_length() - _OCTAVE_BITS - 1)
        bucket = (shift << _OCTAVE_BITS) + (units >> shift)
        self.counts[min(bucket, _BUCKETS - 1)] += 1
        self.total += 1
        self.longest_ns = max(self.longest_ns, ns)

    def quantile_ns(self, share: float) -> int | None:
        """Return the quantile `share` of the times, ns, rounded up; None without times.

        The result is the upper limit of a bucket, but at most the longest time.
        """
        left = share * self.total
        for bucket, count in enumerate(self.counts):
            left -= count
            if count and left <= 0:
                return min(_upper_ns(bucket), self.longest_ns)
        return None


def _upper_ns(bucket: int) -> int:
    """Return the upper limit of a bucket, ns."""
    shift = max(0, (bucket >> _OCTAVE_BITS) - 1)
    units = bucket - (shift << _OCTAVE_BITS) + 1
    return units << (shift + _UNIT_BITS)


@dataclass(frozen=True, slots=True)
class StageLatency:
    """Quantiles of the latency of one stage, ns."""

    p50_ns: int
    p99_ns: int
    max_ns: int


@dataclass(frozen=True, slots=True)
class LatencyHealth:
    """Latency of the frames in one interval between two health messages."""

    frames: int
    """Number of fused frames."""
    stages: Mapping[str, StageLatency | None]
    """Latency by stage, in the order of processing; None for a stage that no frame has passed."""


STAGES = ("decoded", "aligned", "fused", "encoded", "written", "total")
"""Processing stages of a frame. The latency of a stage is the time since the end of the previous
stage. The latency of ``decoded`` is the time since the arrival. ``total`` is the time from the
arrival to the end of ``written``."""


class FrameLatency:
    """Measures the processing stages of every frame; a `StageObserver` of the core.

    Parameters
    ----------
    clock
        Function that returns the current instant, CLOCK_MONOTONIC ns.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._histograms = {stage: LatencyHistogram() for stage in STAGES}
        self._arrival_ns = self._decoded_ns = self._aligned_ns = 0
        self._fused: deque[tuple[int, int]] = deque()
        """Instants at which processing began and fusion ended, ns, for each frame not encoded
        yet."""
        self.end_interval()

    def end_interval(self) -> None:
        """Set `health` to the latency since the last call, and start the next interval."""
        found = self._histograms
        self._histograms = {stage: LatencyHistogram() for stage in STAGES}
        stages: dict[str, StageLatency | None] = {}
        for stage, histogram in found.items():
            p50_ns, p99_ns = histogram.quantile_ns(0.5), histogram.quantile_ns(0.99)
            stages[stage] = None
            if p50_ns is not None and p99_ns is not None:
                stages[stage] = StageLatency(p50_ns, p99_ns, histogram.longest_ns)
        self.health = LatencyHealth(found["fused"].total, stages)

    def mark_decoded(self, arrival_ns: int) -> None:
        """Store the instant at which decoding of a chunk ended."""
        self._arrival_ns, self._decoded_ns = arrival_ns, self._clock()

    def mark_aligned(self) -> None:
        """Store the instant at which one or more frames were released."""
        self._aligned_ns = self._clock()
        self._fused.clear()  # states of the previous event that no output encoded

    def mark_fused(self, deadline_ns: int | None) -> None:
        """Count the latency of a frame up to the fusion.

        The latency begins at `deadline_ns` or, if this is None, at the arrival of the last chunk.
        """
        found, fused_ns = self._histograms, self._clock()
        if deadline_ns is None:
            began_ns, decoded_ns = self._arrival_ns, self._decoded_ns
            found["decoded"].add(decoded_ns - began_ns)
        else:
            began_ns = decoded_ns = deadline_ns

        found["aligned"].add(self._aligned_ns - decoded_ns)
        found["fused"].add(fused_ns - self._aligned_ns)
        self._fused.append((began_ns, fused_ns))

    def mark_encoded(self) -> Callable[[], None] | None:
        """Count the encoding of a frame, and return the function to call when the frame is written.

        Frames are encoded in the order of their fusion. The result is None if the fusion of the
        frame was not observed.
        """
        if not self._fused:
            return None
        encoded_ns = self._clock()
        began_ns, fused_ns = self._fused.popleft()
        self._histograms["encoded"].add(encoded_ns - fused_ns)
        return partial(self._mark_written, began_ns, encoded_ns)

    def _mark_written(self, began_ns: int, encoded_ns: int) -> None:
        now_ns = self._clock()
        self._histograms["written"].add(now_ns - encoded_ns)
        self._histograms["total"].add(now_ns - began_ns)
