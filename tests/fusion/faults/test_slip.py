"""Size and duration above which a difference between two sensors of a segment is a fault."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import pytest

from jointfit_daemon.fusion.faults._slip import FaultDebouncer, SlipDetector, untrained_link

MS = 1_000_000
BEGIN_NS = 7_000_000_000


def first_change(debouncer: FaultDebouncer, difference: float) -> int | None:
    """Return the time, ms, after which a constant difference starts or ends the fault.

    The limit of the difference is 1.
    """
    for ms in range(0, 4000, 10):
        if debouncer.update(BEGIN_NS + ms * MS, difference, 1.0):
            return ms
    return None


def test_a_fault_begins_after_half_a_second_and_ends_after_two() -> None:
    debouncer = FaultDebouncer()
    assert first_change(debouncer, 1.0) is None
    assert first_change(debouncer, 1.01) == 500
    assert debouncer.active
    assert first_change(debouncer, 0.66) is None
    assert first_change(debouncer, 0.64) == 2000
    assert not debouncer.active


def test_a_pair_that_agrees_perfectly_in_calibration_may_differ_by_six_degrees() -> None:
    assert SlipDetector(
        replace(untrained_link("a", "b"), spread=0.0, total=0.0)
    ).limit == pytest.approx(radians(6.0))
