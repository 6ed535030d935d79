"""Processor time per byte over many inputs of one target: median and worst."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING

from tests.fuzz.target import REPEATS, measure_case

if TYPE_CHECKING:
    from tests.fuzz.target import Target

LEAST_BYTES = 256
"""Shortest compared input, bytes. For shorter inputs, creating the decoder takes most of the time.
"""
STEEPEST = 20.0
"""Largest accepted ratio of the worst to the median time per byte."""
SETTLED = 1_000
"""Number of inputs after which the median is used."""
_BINS = 16
"""Bins of the histogram for each factor of two."""


class ByteCosts:
    """Median and worst processor time per byte.

    The worst input is repeated, and its shortest time counts, because the machine may pause.

    Parameters
    ----------
    target : Target
        Target that receives the inputs.
    """

    def __init__(self, target: Target) -> None:
        self._target = target
        self._bins: Counter[int] = Counter()
        self.worst_s = 0.0
        """Largest processor time per byte of an input, s."""

    def add(self, data: bytes, seconds: float) -> str:
        """Add one input; return a finding if its time per byte is too long, else an empty text."""
        if len(data) < LEAST_BYTES:
            return ""
        per_byte = max(seconds, 1e-9) / len(data)
        self._bins[round(_BINS * math.log2(per_byte))] += 1
        if per_byte <= self.worst_s:
            return ""

        again = min(measure_case(self._target, data)[0] for _ in range(REPEATS)) / len(data)
        self.worst_s = max(self.worst_s, min(per_byte, again))
        settled = self._bins.total() >= SETTLED
        if not settled or min(per_byte, again) <= STEEPEST * self.median_s:
            return ""
        return (
            f"uneven: {1e6 * again:.1f} us per byte for {len(data)} bytes, "
            f"median {1e6 * self.median_s:.2f} us"
        )

    @property
    def median_s(self) -> float:
        """Median processor time per byte, s; 0 without inputs."""
        half = self._bins.total() / 2
        below = 0
        for place, count in sorted(self._bins.items()):
            below += count
            if below >= half:
                return float(2.0 ** (place / _BINS))
        return 0.0

    @property
    def ratio(self) -> float | None:
        """Ratio of the worst to the median time per byte; None without enough inputs."""
        if self._bins.total() < SETTLED:
            return None
        return self.worst_s / self.median_s
