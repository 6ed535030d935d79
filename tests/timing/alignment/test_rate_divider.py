"""Rate divider: mean rate of the selected frames, pauses, and wrong stamps."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.timing.alignment import RateDivider

NS = 1_000_000_000


@given(st.floats(1.0, 100.0), st.floats(100.0, 400.0), st.integers(0, 10**15))
def test_mean_rate_is_the_wanted_one(wanted_hz: float, frames_hz: float, start_ns: int) -> None:
    divider = RateDivider(wanted_hz)
    stamps = [start_ns + round(k * NS / frames_hz) for k in range(round(30 * frames_hz))]
    selected = [t for t in stamps if divider.is_due(t)]
    assert len(selected) == pytest.approx(30 * wanted_hz, abs=2)


def test_frames_after_a_pause_are_not_made_up_for() -> None:
    divider = RateDivider(10.0)
    stamps = [k * NS // 100 for k in range(100)] + [60 * NS + k * NS // 100 for k in range(100)]
    assert sum(divider.is_due(t) for t in stamps) == pytest.approx(20, abs=1)


def test_one_stamp_far_ahead_excludes_none_of_the_following_frames() -> None:
    divider = RateDivider(10.0)
    stamps = [k * NS // 100 for k in range(200)]
    stamps[50] += 3600 * NS
    assert sum(divider.is_due(t) for t in stamps) == pytest.approx(20, abs=2)


def test_frames_out_of_order_are_not_selected_twice() -> None:
    divider = RateDivider(10.0)
    stamps = [k * NS // 100 for k in range(100)]
    stamps += stamps[60:] + [k * NS // 100 for k in range(100, 200)]
    assert sum(divider.is_due(t) for t in stamps) == pytest.approx(20, abs=1)
