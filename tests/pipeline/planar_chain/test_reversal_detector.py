"""Reversal detector: correct, exchanged and undecided labels of the two markers of a segment."""

from __future__ import annotations

from cmath import exp
from math import nan

import pytest

from jointfit_daemon.pipeline.planar_chain._reversal_detector import (
    KEPT_NS,
    AdjacentMarker,
    Labels,
    PlanarPose,
    ReversalDetector,
)

HIDDEN = AdjacentMarker(0.2j, (0.15,), complex(nan, nan))


def update(
    detector: ReversalDetector,
    t_s: float,
    angle: float,
    *adjacent: AdjacentMarker,
    reversible: bool = True,
) -> Labels:
    turn = exp(1j * angle)
    poses = PlanarPose(turn, 0.5j), PlanarPose(-turn, 0.5j)
    return detector.update(round(1e9 * t_s), poses, lambda: list(adjacent), reversible=reversible)


@pytest.mark.parametrize(
    ("angle", "labels"), [(1.4, Labels.CORRECT), (1.8, Labels.RENEWED), (-3.1, Labels.RENEWED)]
)
def test_rotation_decides_without_joint_centers(angle: float, labels: Labels) -> None:
    """If no joint center decides, the labels after more than a quarter turn count as renewed."""
    detector = ReversalDetector()
    assert update(detector, 0.0, 0.0) is Labels.CORRECT
    assert update(detector, 1.0, angle) is labels


def test_three_markers_cannot_be_reversed() -> None:
    detector = ReversalDetector()
    update(detector, 0.0, 0.0, HIDDEN)
    assert update(detector, 1.0, 3.0, HIDDEN, reversible=False) is Labels.CORRECT


def test_joint_center_decides_although_the_marker_is_hidden_at_first() -> None:
    detector = ReversalDetector()
    update(detector, 0.0, 0.0, HIDDEN)
    assert update(detector, 1.0, 3.0, HIDDEN) is Labels.UNDECIDED
    assert update(detector, 1.05, 3.0, HIDDEN) is Labels.UNDECIDED
    point = 0.5j + exp(3.0j) * (0.2j + 0.15)  # the adjacent marker after a rotation by 3 rad
    assert update(detector, 1.1, 3.0, HIDDEN._replace(point=point)) is Labels.CORRECT
    assert update(detector, 1.15, 3.05) is Labels.CORRECT

    assert update(detector, 2.0, 3.0, HIDDEN._replace(point=1j - point)) is Labels.EXCHANGED
    assert update(detector, 2.05, 3.0) is Labels.EXCHANGED
    assert update(detector, 2.10, 3.05 - 3.14) is Labels.CORRECT


def test_undecided_labels_are_renewed_after_a_minute() -> None:
    detector = ReversalDetector()
    update(detector, 0.0, 0.0, HIDDEN)
    times = [1.0 + 0.05 * k for k in range(round(20e-9 * KEPT_NS) + 1)]
    found = [update(detector, t_s, 0.0, HIDDEN) for t_s in times]
    assert found == [Labels.UNDECIDED] * (len(times) - 1) + [Labels.RENEWED]
