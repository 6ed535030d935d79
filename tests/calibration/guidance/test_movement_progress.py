"""Progress of a functional movement: arcs, flexions, and the effect of a lost sensor."""

from __future__ import annotations

import math

import pytest

from jointfit_daemon.calibration.guidance._movement_progress import MovementProgress
from jointfit_daemon.model import Chain

CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1", "S2"), ("S3", "S4")))
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def about_x(degrees: float) -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2
    return (math.cos(half), math.sin(half), 0.0, 0.0)


def test_arc_is_the_relative_rotation_of_the_segments() -> None:
    progress = MovementProgress(CHAIN)
    for degrees in range(-10, 51, 5):  # both segments also rotate by 20 degrees
        progress.update({"S1": about_x(20 + degrees), "S3": about_x(20 + 2 * degrees)})
    assert math.degrees(progress.arcs()["knee"]) == pytest.approx(60.0)


def test_a_sensor_that_takes_over_for_a_lost_one_adds_no_arc() -> None:
    progress = MovementProgress(CHAIN)
    progress.update({"S1": UPRIGHT, "S2": about_x(90), "S3": UPRIGHT})
    progress.update({"S1": UPRIGHT, "S2": about_x(90), "S3": about_x(10)})
    # S2 replaces S1, and has another sensor-to-segment alignment. The joint does not move.
    progress.update({"S2": about_x(90), "S3": about_x(10)})
    assert math.degrees(progress.arcs()["knee"]) == pytest.approx(10.0)


def test_more_arc_and_more_time_reduce_the_predicted_error() -> None:
    errors = []
    for arc in (20.0, 60.0):
        progress = MovementProgress(CHAIN)
        progress.update({"S1": UPRIGHT, "S3": UPRIGHT})
        progress.update({"S1": UPRIGHT, "S3": about_x(arc)})
        errors += [progress.predicted_center_errors(s)["knee"] or math.nan for s in (5.0, 20.0)]
    assert errors == sorted(errors, reverse=True)
    assert len(set(errors)) == len(errors)


def test_without_movement_no_error_is_predicted() -> None:
    progress = MovementProgress(CHAIN)
    progress.update({"S1": UPRIGHT, "S3": UPRIGHT})
    assert progress.predicted_center_errors(10.0) == {"knee": None}
    assert MovementProgress(CHAIN).predicted_center_errors(10.0) == {}


@pytest.mark.parametrize("segments", [1, 3])
def test_a_chain_of_any_length_has_its_inner_joints(segments: int) -> None:
    names = tuple(f"s{i}" for i in range(segments))
    chain = Chain(
        tuple(f"J{i}" for i in range(segments + 1)),
        names,
        tuple((f"S{i}",) for i in range(segments)),
    )
    progress = MovementProgress(chain)
    progress.update({f"S{i}": UPRIGHT for i in range(segments)})
    assert list(progress.arcs()) == [f"J{i}" for i in range(1, segments)]


def test_bends_are_counted_from_the_static_pose_wherever_the_movement_begins() -> None:
    progress = MovementProgress(CHAIN, {"S1": UPRIGHT, "S3": UPRIGHT})
    for _ in range(4):
        for degrees in (60, 20, 40, 5):  # at 20° the joint is not extended, so this is one flexion
            progress.update({"S1": UPRIGHT, "S3": about_x(degrees)})
    assert progress.bends() == {"knee": 4}
