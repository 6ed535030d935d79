"""Samples that a fitted clock does not explain: too early, or late for good.

Law: pure; one small state a clock. Lateness is one-sided: a wire, a queue or a starved host delays
samples by any amount and for any time, and the clock is none the worse. So late samples are news
only if the fastest of them agree with each other for two seconds, as those of a clock that stood
still do and those of a jam do not. And nothing comes before it was taken; but one such sample may
be a wrong stamp, and only three in a row are a clock that jumped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.timing.clock._clock_events import too_early, too_late
from jointfit_daemon.timing.clock._stamps import STEP_NS

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock._clock_events import ClockNews

LATE_NS = 50_000_000
LATE_FOR_NS = 2_000_000_000
LATE_SIGMAS = 20.0
LOOKS = 4
"""Parts of that time whose fastest samples must agree."""
JITTER_NS = 25_000_000
"""How far above the fastest samples the others of a clock that stood still may be on average."""
EARLY_SAMPLES = 3

_LOOK_NS = LATE_FOR_NS // LOOKS


class _Look(NamedTuple):
    """Half a second of late samples."""

    least: float
    total: float
    samples: int

    def and_(self, excess_ns: float) -> _Look:
        """Return the look with one sample more."""
        return _Look(min(self.least, excess_ns), self.total + excess_ns, self.samples + 1)

    def agrees(self, least: float) -> bool:
        """Tell whether its samples, but for the usual jitter, are late by `least`."""
        return self.least - least <= STEP_NS and self.total / self.samples - least <= JITTER_NS


class Plausibility:
    """Judges every sample of a settled clock."""

    __slots__ = ("_look", "_looks", "_until_ns", "any", "early")

    def __init__(self) -> None:
        self.any = False
        """Whether the last sample was not as it should be."""
        self.early = 0
        """Samples in a row that were too early; if any, the next ones must tell why."""
        self._until_ns: int | None = None
        self._looks: list[_Look] = []
        self._look = _Look(0.0, 0.0, 1)

    def clear(self) -> None:
        """Take a sample that is as it should be."""
        self.any, self.early, self._until_ns = False, 0, None

    def feed(self, excess_ns: float, sigma_ns: float, arrival_ns: int) -> ClockNews | None:
        """Return what follows from a sample that far later than the fastest ones, if anything."""
        self.any = True
        if excess_ns < -STEP_NS:
            self.early += 1
            return too_early(-excess_ns) if self.early >= EARLY_SAMPLES else None
        self.early = 0
        if excess_ns < LATE_NS or excess_ns < LATE_SIGMAS * sigma_ns:
            self.clear()
            return None
        return self._late(excess_ns, arrival_ns)

    def _late(self, excess_ns: float, arrival_ns: int) -> ClockNews | None:
        if self._until_ns is not None and arrival_ns < self._until_ns:
            self._look = self._look.and_(excess_ns)
            return None
        looks = self._looks
        if self._until_ns is None:
            looks.clear()
        else:
            looks.append(self._look)
            del looks[:-LOOKS]
        self._until_ns, self._look = arrival_ns + _LOOK_NS, _Look(excess_ns, excess_ns, 1)
        if len(looks) < LOOKS:
            return None
        least = min(look.least for look in looks)
        agreed = all(look.agrees(least) for look in looks)
        return too_late(least, LATE_FOR_NS / 1e9) if agreed else None
