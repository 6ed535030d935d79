"""Exchanged labels are found by the shapes of the clusters; healthy labels cause no finding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    LabelExamination,
    LabelSearch,
    MarkerCluster,
    explain_trial,
    rigid_fit,
)
from tests.limb_model.clusters_of_limb import LABELS, centers_of, cycled, person

EXCHANGES = [
    ("thigh0", "thigh2"),
    ("shank1", "shank2"),
    ("thigh1", "shank3"),
    ("thigh3", "shank0"),
    ("foot0", "foot1", "foot2"),
    ("pelvis0", "thigh1", "shank2"),
    ("thigh0", "thigh1", "shank2"),
    ("thigh0", "thigh1", "thigh2", "thigh3"),
    ("pelvis0", "thigh1", "shank2", "foot3"),
]
"""Markers whose labels are exchanged in a cycle: within a segment, and across two to four."""


def test_residuals_are_those_of_the_fit_of_a_trial() -> None:
    clusters, _, positions = person(1, occluded=0.15)
    search = LabelSearch(clusters)
    for points in positions[::60]:
        found = search.explain(points).rms
        for p, cluster in enumerate(clusters):
            rows = [LABELS.index(name) for name in cluster.markers]
            expected = rigid_fit(cluster.template, points[None, rows])[2][0]
            assert found[p] == pytest.approx(expected, abs=1e-9, nan_ok=True)


def test_a_cluster_of_hundreds_of_markers_is_searched_and_fits() -> None:
    points = np.random.default_rng(3).uniform(-0.2, 0.2, (300, 3))
    names = tuple(f"M{i}" for i in range(300))
    upright = np.array((1.0, 0.0, 0.0, 0.0))
    cluster = MarkerCluster("thigh", names, None, points, np.zeros(3), upright)
    finding = LabelSearch([cluster]).explain(points)
    # The error is the root of a difference of squares, so its accuracy is only the root of their
    # rounding error.
    assert finding.rms[0] < 4.0 * np.sqrt(np.finfo(float).eps * np.mean(points**2))
    assert finding.faults == ()


@pytest.mark.parametrize("labels", EXCHANGES, ids="-".join)
def test_an_exchange_is_named_in_most_frames_and_hardly_ever_another_one(
    labels: tuple[str, ...],
) -> None:
    clusters, _, positions = person(2, skin_m=0.006, occluded=0.02)
    search = LabelSearch(clusters, centers_of(clusters))
    found = [search.explain(cycled(points, *labels)).faults for points in positions[::24]]
    parts = tuple(sorted({name[:-1] for name in labels}))
    right = [len(one) == 1 and (one[0].markers, one[0].parts) == (labels, parts) for one in found]
    wrong = [bool(one) and not ok for one, ok in zip(found, right, strict=True)]
    assert np.mean(right) > 0.75
    assert np.mean(wrong) < 0.15  # one of the markers is hidden


@pytest.mark.parametrize("labels", EXCHANGES, ids="-".join)
def test_a_search_spread_over_frames_finds_the_same_with_one_cluster_a_frame(
    labels: tuple[str, ...],
) -> None:
    """A search of one cluster per frame finds the same faults as a search of all in one frame."""
    clusters, _, positions = person(2, skin_m=0.006, occluded=0.02)
    search = LabelSearch(clusters, centers_of(clusters))
    for points in cycled(positions[::240], *labels):
        examination, frames = LabelExamination(search, 0, points), 0
        finding = None
        while finding is None:
            finding = examination.advance(10_000_000 * frames)
            frames += 1
        expected = search.explain(points)
        np.testing.assert_array_equal(finding.rms, expected.rms)
        assert finding.faults == expected.faults
        suspects = int((expected.rms > 0.012).sum())
        assert suspects + (suspects > 0) <= frames <= len(clusters) + 4


def test_a_search_is_finished_in_few_frames_of_slow_cameras() -> None:
    clusters, _, positions = person(2)
    points = cycled(positions[300], "pelvis0", "thigh1", "shank2", "foot3")
    examination = LabelExamination(LabelSearch(clusters), 0, points)
    found = [examination.advance(k * 100_000_000) for k in range(3)]
    assert found[-1] is not None
    assert found[:-1] == [None, None]


def test_two_independent_exchanges_are_two_faults() -> None:
    clusters, _, positions = person(2)
    points = cycled(cycled(positions[300], "thigh0", "shank0"), "foot1", "foot2")
    faults = LabelSearch(clusters).explain(points).faults
    assert {fault.markers for fault in faults} == {("thigh0", "shank0"), ("foot1", "foot2")}


def test_a_label_on_the_marker_of_another_segment_is_named_with_its_place() -> None:
    clusters, _, positions = person(2)
    points = positions[300].copy()
    thigh, shank = LABELS.index("thigh1"), LABELS.index("shank2")
    points[shank], points[thigh] = points[thigh], np.nan
    (fault,) = LabelSearch(clusters).explain(points).faults
    assert (fault.markers, fault.cycle) == (("shank2", "thigh1"), False)
    assert fault.places == "shank2 is at the place of thigh1"


def test_a_displaced_marker_is_named_alone() -> None:
    clusters, _, positions = person(2)
    points = positions[300].copy()
    points[LABELS.index("thigh1")] += [0.08, 0.05, -0.04]
    (fault,) = LabelSearch(clusters).explain(points).faults
    assert fault.markers == ("thigh1",)


@pytest.mark.parametrize("seed", range(3, 7))
def test_soft_tissue_artefact_and_occlusions_are_no_exchange(seed: int) -> None:
    clusters, _, positions = person(seed, skin_m=0.01, occluded=0.1)
    search = LabelSearch(clusters, centers_of(clusters))
    found = [search.explain(points).faults for points in positions[::24]]
    assert np.mean([bool(one) for one in found]) < 0.1


@pytest.mark.parametrize(
    "labels", [("thigh0", "thigh1"), ("thigh1", "thigh3"), ("thigh0", "thigh2")]
)
def test_joint_centers_reveal_an_exchange_on_a_rectangular_plate(labels: tuple[str, str]) -> None:
    # An exchange of two corners of a rectangle yields the same shape as an exchange of the other
    # two corners. The shape alone therefore does not show which labels are wrong.
    clusters, _, positions = person(2)
    rows = [LABELS.index(f"thigh{k}") for k in range(4)]
    corners = np.array([[0.06, 0, 0.03], [0.06, 0, -0.03], [-0.06, 0, -0.03], [-0.06, 0, 0.03]])
    thigh = clusters[1]
    plate = replace(thigh, template=corners)
    pose = rigid_fit(thigh.template, positions[300, rows][None])
    points = positions[300].copy()
    points[rows] = rotation.rotate(pose[0], corners) + pose[1]
    changed = [clusters[0], plate, *clusters[2:]]
    search = LabelSearch(changed, centers_of(clusters))
    (fault,) = search.explain(cycled(points, *labels)).faults
    assert fault.markers == labels
    assert search.explain(points).faults == ()
    rng, alone = np.random.default_rng(1), LabelSearch(changed)
    for _ in range(20):
        noisy = cycled(points, *labels) + rng.normal(0.0, 0.002, points.shape)
        assert alone.explain(noisy).faults == ()


def test_markers_that_look_alike_after_an_exchange_are_ambiguous() -> None:
    # an equilateral triangle: every exchange of two labels is a rotation
    corners = np.array([[np.cos(a), np.sin(a), 0.0] for a in 2 * np.pi / 3 * np.arange(3)]) * 0.1
    triangle = MarkerCluster("thigh", LABELS[:3], None, corners, np.zeros(3), np.eye(4)[0])
    finding = LabelSearch([triangle]).explain(corners[[1, 0, 2]])
    assert finding.rms == pytest.approx(0.0, abs=1e-9)
    assert finding.faults == ()


@given(st.integers(0, 2**32 - 1), st.integers(0, 16))
@settings(max_examples=40)
def test_no_input_raises_and_few_visible_markers_have_no_residual(seed: int, hidden: int) -> None:
    rng = np.random.default_rng(seed)
    clusters = person(1)[0]
    points = rng.normal(0.0, 0.3, (16, 3))
    points[rng.permutation(16)[:hidden]] = np.nan
    rms, faults = LabelSearch(clusters).explain(points)
    for p, cluster in enumerate(clusters):
        rows = [LABELS.index(name) for name in cluster.markers]
        if np.isfinite(points[rows]).all(axis=1).sum() < 3:
            assert np.isnan(rms[p])
    named = [name for fault in faults for name in fault.markers]
    assert len(named) == len(set(named))


def test_a_trial_names_the_exchange_of_its_second_half() -> None:
    clusters, _, positions = person(5)
    mixed = positions.copy()
    mixed[len(mixed) // 2 :] = cycled(mixed[len(mixed) // 2 :], "shank0", "shank3")
    (fault,) = explain_trial(LabelSearch(clusters), mixed)
    assert fault.markers == ("shank0", "shank3")
    assert explain_trial(LabelSearch(clusters), positions) == ()
    assert explain_trial(LabelSearch([]), positions[:0, :0]) == ()
