"""Stillness gate: the end of a still period is reported once."""

from __future__ import annotations

from itertools import chain, repeat
from typing import Any

from jointfit_daemon.pipeline.calibration_session._stillness_gate import StillnessGate

PERIOD_NS = 10_000_000


class Scripted:
    """A monitor that returns the given values."""

    def __init__(self, *runs: tuple[bool, int]) -> None:
        self._values = chain.from_iterable(repeat(still, times) for still, times in runs)

    def feed(self, t_ns: int, q: object) -> bool:
        del t_ns, q
        return next(self._values)


def test_movement_around_the_limit_is_reported_once() -> None:
    gate: Any = StillnessGate(["S1"])
    gate._monitors["S1"] = Scripted(
        (True, 100), (False, 4), (True, 4), (False, 50), (True, 60), (False, 2)
    )
    ended = [k for k in range(220) if gate.feed("S1", k * PERIOD_NS, None)]
    assert ended == [100, 218]
