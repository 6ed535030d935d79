"""Weights of training frames by the density of their postures."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.calibration.soft_tissue._posture_weights import BANDWIDTH, weigh_postures

REST, MOVED = 900, 100


def rest_and_movement(seed: int) -> np.ndarray:
    """Return regressors of 900 frames of rest and 100 frames of an even movement, rad."""
    rng = np.random.default_rng(seed)
    u = rng.normal(0.0, 0.005, (REST + MOVED, 9))
    u[REST:, 0] += np.linspace(0.0, -1.8, MOVED)
    u[REST:, 6] += np.linspace(0.0, 0.9, MOVED)
    return u


@given(st.integers(0, 1000), st.integers(1, 700))
def test_weights_are_positive_with_mean_one(seed: int, count: int) -> None:
    weights = weigh_postures(np.random.default_rng(seed).normal(0.0, 0.5, (count, 9)))
    assert weights.shape == (count,)
    assert np.all(weights > 0.0)
    assert abs(float(np.mean(weights)) - 1.0) < 1e-12


def test_rare_postures_have_more_weight_than_rest() -> None:
    weights = weigh_postures(rest_and_movement(1))
    away = weights[REST + 30 :]
    assert np.min(away) > 1.7 * np.median(weights[:REST])

    # Rest has nine tenths of the frames, and about three quarters of the weight.
    assert 0.7 < np.sum(weights[:REST]) / np.sum(weights) < 0.85


def test_weight_decreases_with_the_fourth_root_of_the_number_of_equal_frames() -> None:
    apart = 40.0 * BANDWIDTH
    few, many = np.zeros((30, 9)), np.zeros((480, 9))
    many[:, 0] = apart
    weights = weigh_postures(np.concatenate([few, many]))
    assert abs(weights[0] / weights[-1] - 2.0) < 0.02


def test_disagreement_of_the_sensors_is_no_posture() -> None:
    """Differences between the sensors (regressors 3 to 5) do not affect the weights."""
    u = rest_and_movement(2)
    other = u.copy()
    other[:, 3:6] += np.random.default_rng(3).normal(0.0, 0.5, (len(u), 3))
    np.testing.assert_array_equal(weigh_postures(u), weigh_postures(other))


def test_leaning_segment_with_a_straight_joint_is_another_posture() -> None:
    u = np.zeros((500, 9))
    u[-20:, 7] = 0.8
    weights = weigh_postures(u)
    assert weights[-1] > 1.7 * weights[0]
