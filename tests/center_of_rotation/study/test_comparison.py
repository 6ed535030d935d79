"""Geometric methods of the study: exact without noise, and their errors relative to each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.center_of_rotation.planar import three_frame_center
from jointfit_daemon.center_of_rotation.study import (
    RADII_M,
    STEPS_RAD,
    StudySetup,
    average_repetitions,
    bisector_center,
    compare_methods,
    effect_of_radius,
    rotation_pole,
)

places = st.floats(-2.0, 2.0)


@given(places, places, st.floats(0.1, 3.0), st.floats(0.05, 0.6), st.integers(0, 1000))
def test_every_method_finds_the_center_of_an_exact_rotation(
    x: float, y: float, turn: float, size: float, seed: int
) -> None:
    center = np.array([x, y])
    first = size * np.array([[1.0, 0.2], [-0.3, 0.9], [0.1, -1.0]])
    first += 0.1 * size * np.random.default_rng(seed).uniform(-1.0, 1.0, (3, 2))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    second = first @ rotation.T
    np.testing.assert_allclose(rotation_pole(first + center, second + center), center, atol=1e-9)
    frames = np.stack((first, second), axis=1) + center
    np.testing.assert_allclose(bisector_center(frames), center, atol=1e-7)


@given(st.integers(0, 10_000))
def test_bisectors_of_one_marker_in_three_frames_are_the_three_frame_solution(seed: int) -> None:
    angles = np.array([0.0, 0.7, 1.9])
    points = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    points += np.random.default_rng(seed).normal(0.0, 0.05, points.shape)
    np.testing.assert_allclose(bisector_center(points[None]), three_frame_center(points), rtol=1e-6)


def test_without_rotation_there_is_no_center() -> None:
    markers = np.array([[0.1, 0.0], [0.0, 0.2]])
    assert not np.isfinite(rotation_pole(markers, markers + 0.5)).any()
    assert not np.isfinite(bisector_center(np.stack((markers, markers), axis=1))).any()


def test_two_markers_reduce_the_error_of_short_arcs_and_all_frames_that_of_long_ones() -> None:
    steps = np.deg2rad([10.0, 90.0])
    found = compare_methods(replace(StudySetup(), steps=steps, frames_repeats=200))
    short, long = (
        dict(zip(found, column, strict=True)) for column in np.array([*found.values()]).T
    )
    assert max(short["bisectors"], short["Reuleaux"], short["helical axis"]) < (
        short["three frames"] / 5
    )
    assert long["hyper"] < min(long["bisectors"], long["Reuleaux"], long["helical axis"]) / 2
    assert long["three frames"] == pytest.approx(0.00111, rel=0.1)


def test_averaged_centers_of_small_angles_are_worse_than_centers_of_averaged_positions() -> None:
    found = average_repetitions(StudySetup())
    at = dict(zip(np.rint(np.rad2deg(STEPS_RAD)).tolist(), range(len(STEPS_RAD)), strict=True))
    assert found.mean_of_centers[at[10]] > 3.0 * found.center_of_means[at[10]]
    # at a large angle, both errors decrease with the root of the number of repetitions
    expected = 0.001 * 4.3 / np.sqrt(StudySetup().repeats)
    assert found.mean_of_centers[at[45]] < expected
    assert found.center_of_means[at[45]] < expected


def test_the_radius_matters_below_seven_centimeters_only_for_large_noise() -> None:
    ratio = dict(zip(RADII_M.tolist(), effect_of_radius(StudySetup()).tolist(), strict=True))
    assert ratio[0.03] > 1.8
    assert 1.05 < ratio[0.07] < 1.2
    assert ratio[0.2] == pytest.approx(1.0, abs=0.03)
