"""Correction of a frame: a mixture of two regressions (experts) and a trend, by leverage ratio."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.limb_model import mix_corrections

TREND = np.array([[0.1, -0.2, 0.0]])
A = np.array([[0.03, 0.01, -0.04]])
B = np.array([[-0.02, 0.05, 0.06]])

ratios = st.floats(0.0, 40.0)


def mixed(a_ratio: float, b_ratio: float) -> np.ndarray:
    """Return the mixed correction of one frame, rad, shape (3,)."""
    found: np.ndarray = mix_corrections(TREND, A, np.array([a_ratio]), B, np.array([b_ratio]))[0]
    return found


def test_expert_with_tilt_alone_corrects_the_middle_of_the_training_range() -> None:
    for b_ratio in (0.0, 0.2, 0.5):
        np.testing.assert_allclose(mixed(0.3, b_ratio), B[0], atol=1e-15)


def test_both_experts_have_equal_weight_at_the_limit_of_the_training_range() -> None:
    np.testing.assert_allclose(mixed(1.0, 1.0), 0.5 * (A[0] + B[0]), atol=1e-15)


def test_trend_replaces_both_experts_about_the_horizontal_axes_far_outside() -> None:
    far = mixed(3e6, 1e6)
    np.testing.assert_allclose(far[:2], TREND[0, :2], atol=1e-3)
    assert abs(far[2]) < 1e-3


@given(ratios, ratios)
def test_mixed_correction_is_a_continuous_function_of_both_leverage_ratios(
    a_ratio: float, b_ratio: float
) -> None:
    step = 1e-6
    here = mixed(a_ratio, b_ratio)
    for there in (mixed(a_ratio + step, b_ratio), mixed(a_ratio, b_ratio + step)):
        assert np.max(np.abs(there - here)) < step


@given(ratios, ratios)
def test_mixed_correction_lies_between_the_smallest_and_largest_of_its_parts(
    a_ratio: float, b_ratio: float
) -> None:
    parts = np.concatenate([A, B, TREND])
    found = mixed(a_ratio, b_ratio)
    assert np.all(found >= parts.min(axis=0) - 1e-12)
    assert np.all(found <= parts.max(axis=0) + 1e-12)
