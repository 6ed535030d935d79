"""Headings that turn within seconds: who is believed, and what is admitted not to be known."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.fusion.faults._magnetic_disturbance import Look, SuddenTurns

LEG = (("S1", "S2"), ("S3", "S4"))
DEG = math.pi / 180.0
SD = 2.0 * DEG
LOOK_NS = 40_000_000


def watched(
    groups: tuple[tuple[str, ...], ...], off_deg: dict[str, float], seconds: float = 6.0
) -> SuddenTurns:
    """Return what is made of headings that have been off for so long."""
    turns = SuddenTurns(groups)
    ways = [*(way for group in groups for way in pairwise(group))]
    ways += [(above[0], below[0]) for above, below in pairwise(groups)]
    for k in range(round(seconds * 25)):
        looks = [Look(a, b, (off_deg.get(b, 0.0) - off_deg.get(a, 0.0)) * DEG, SD) for a, b in ways]
        turns.look(k * LOOK_NS, looks)
    return turns


@pytest.mark.parametrize("name", ["S1", "S2", "S3", "S4"])
@given(off_deg=st.floats(15.0, 170.0), left=st.booleans())
def test_one_of_four_is_put_right_and_the_others_stay(
    name: str, off_deg: float, left: bool
) -> None:
    off = -off_deg if left else off_deg
    turns = watched(LEG, {name: off})
    assert turns.taken == {name: pytest.approx(off * DEG, rel=1e-3)}
    partner = next(other for group in LEG if name in group for other in group if other != name)
    found = turns.odd(*sorted((name, partner)))
    assert found is not None
    assert found[0] == name
    assert found[1] == pytest.approx(off * DEG, rel=1e-3)
    assert turns.unsure == pytest.approx(SD, rel=1e-3)  # what iron does to the others is not seen


@given(off_deg=st.floats(20.0, 80.0))
def test_of_two_segments_nobody_knows_which_one_turned(off_deg: float) -> None:
    turns = watched(LEG, {"S3": off_deg, "S4": off_deg})
    half = 0.5 * off_deg * DEG
    assert turns.taken["S3"] - turns.taken["S1"] == pytest.approx(off_deg * DEG, rel=1e-3)
    assert turns.taken["S3"] == turns.taken["S4"] == pytest.approx(half, rel=1e-3)
    assert turns.unsure == pytest.approx(half, rel=1e-3)
    assert turns.odd("S3", "S4") is None


def test_a_lone_sensor_is_not_outvoted_by_two_that_share_a_segment() -> None:
    turns = watched((("S1", "S2"), ("S3",)), {"S3": 40.0})
    assert turns.unsure == pytest.approx(20.0 * DEG, rel=1e-3)


def test_of_three_segments_the_odd_one_is_known() -> None:
    turns = watched((*LEG, ("S5", "S6")), {"S3": 30.0, "S4": 30.0})
    assert turns.taken == {name: pytest.approx(30.0 * DEG, rel=1e-3) for name in ("S3", "S4")}
    assert turns.unsure == pytest.approx(SD, rel=1e-3)


def test_what_skin_does_is_left_alone() -> None:
    assert watched(LEG, {"S1": 3.0, "S4": -3.0}).taken == {}


def test_a_segment_that_is_tied_to_none_is_left_alone() -> None:
    turns = SuddenTurns(LEG)
    for k in range(100):
        turns.look(k * LOOK_NS, [Look("S1", "S2", 30.0 * DEG, SD)])
    assert turns.taken == {}
    assert turns.unsure == 0.0


def test_what_is_taken_out_comes_and_goes_without_a_jump() -> None:
    turns = watched(LEG, {"S2": 40.0})
    before, begin_ns = turns.taken["S2"], 150 * LOOK_NS
    for k in range(100):
        turns.look(begin_ns + k * LOOK_NS, [])  # nobody is tied to anybody any more
        now = turns.taken.get("S2", 0.0)
        assert 0.0 <= before - now < 0.2 * 40.0 * DEG
        before = now
    assert turns.taken == {}
    assert turns.unsure == pytest.approx(0.0, abs=1e-3)
