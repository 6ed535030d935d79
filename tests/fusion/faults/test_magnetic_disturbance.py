"""Magnetic disturbances: correction of the disturbed sensors, and remaining uncertainty."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.fusion.faults._magnetic_disturbance import (
    HeadingDifference,
    MagneticDisturbanceDetector,
    _SmoothedDifference,
)

LEG = (("S1", "S2"), ("S3", "S4"))
DEG = math.pi / 180.0
SD = 2.0 * DEG
UPDATE_NS = 40_000_000


def detector_after(
    groups: tuple[tuple[str, ...], ...], off_deg: dict[str, float], seconds: float = 6.0
) -> MagneticDisturbanceDetector:
    """Return a detector after the headings of sensors deviated by `off_deg` for some seconds."""
    detector = MagneticDisturbanceDetector(groups)
    ways = [*(way for group in groups for way in pairwise(group))]
    ways += [(above[0], below[0]) for above, below in pairwise(groups)]
    for k in range(round(seconds * 25)):
        differences = [
            HeadingDifference(a, b, (off_deg.get(b, 0.0) - off_deg.get(a, 0.0)) * DEG, SD)
            for a, b in ways
        ]
        detector.update(k * UPDATE_NS, differences)
    return detector


@pytest.mark.parametrize("name", ["S1", "S2", "S3", "S4"])
@given(off_deg=st.floats(15.0, 170.0), left=st.booleans())
def test_one_disturbed_sensor_of_four_is_corrected_and_no_other(
    name: str, off_deg: float, left: bool
) -> None:
    off = -off_deg if left else off_deg
    detector = detector_after(LEG, {name: off})
    assert detector.corrections == {name: pytest.approx(off * DEG, rel=1e-3)}
    partner = next(other for group in LEG if name in group for other in group if other != name)
    found = detector.outlier(*sorted((name, partner)))
    assert found is not None
    assert found[0] == name
    assert found[1] == pytest.approx(off * DEG, rel=1e-3)
    # A disturbance common to all sensors is not observable.
    assert detector.ambiguity == pytest.approx(SD, rel=1e-3)


@given(off_deg=st.floats(20.0, 80.0))
def test_two_disagreeing_segments_share_the_correction(off_deg: float) -> None:
    detector = detector_after(LEG, {"S3": off_deg, "S4": off_deg})
    half = 0.5 * off_deg * DEG
    assert detector.corrections["S3"] - detector.corrections["S1"] == pytest.approx(
        off_deg * DEG, rel=1e-3
    )
    assert detector.corrections["S3"] == detector.corrections["S4"] == pytest.approx(half, rel=1e-3)
    assert detector.ambiguity == pytest.approx(half, rel=1e-3)
    assert detector.outlier("S3", "S4") is None


def test_segments_have_equal_weight_in_the_median() -> None:
    detector = detector_after((("S1", "S2"), ("S3",)), {"S3": 40.0})
    assert detector.ambiguity == pytest.approx(20.0 * DEG, rel=1e-3)


def test_one_disturbed_segment_of_three_is_identified() -> None:
    detector = detector_after((*LEG, ("S5", "S6")), {"S3": 30.0, "S4": 30.0})
    assert detector.corrections == {
        name: pytest.approx(30.0 * DEG, rel=1e-3) for name in ("S3", "S4")
    }
    assert detector.ambiguity == pytest.approx(SD, rel=1e-3)


def test_soft_tissue_artefacts_are_not_corrected() -> None:
    assert detector_after(LEG, {"S1": 3.0, "S4": -3.0}).corrections == {}


def test_segment_without_hinge_is_not_corrected() -> None:
    detector = MagneticDisturbanceDetector(LEG)
    for k in range(100):
        detector.update(k * UPDATE_NS, [HeadingDifference("S1", "S2", 30.0 * DEG, SD)])
    assert detector.corrections == {}
    assert detector.ambiguity == 0.0


def test_corrections_start_and_end_without_a_jump() -> None:
    detector = detector_after(LEG, {"S2": 40.0})
    before, begin_ns = detector.corrections["S2"], 150 * UPDATE_NS
    for k in range(100):
        detector.update(begin_ns + k * UPDATE_NS, [])  # no sensor pair has data
        now = detector.corrections.get("S2", 0.0)
        assert 0.0 <= before - now < 0.2 * 40.0 * DEG
        before = now
    assert detector.corrections == {}
    assert detector.ambiguity == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("pause_ns", "continues"), [(500_000_000, True), (500_000_001, False)])
def test_a_difference_is_smoothed_across_half_a_second_without_data(
    pause_ns: int, continues: bool
) -> None:
    smoothed = _SmoothedDifference()
    smoothed.update(0, 1.0, SD)
    smoothed.update(pause_ns, 1.0, SD)
    assert (smoothed.angle > 0.0) is continues


def test_a_sensor_without_a_known_deviation_counts_as_undisturbed() -> None:
    detector = detector_after(LEG, {"S2": 40.0})
    assert detector.outlier("S1", "S2") == detector.outlier("other", "S2") is not None
