"""Rates of joint angles, and the conditions in which a rate is unknown."""

from __future__ import annotations

import numpy as np
import pytest

from jointfit_daemon.fusion._angle_rates import AngleRates
from jointfit_daemon.model import JointAngles

MS = 1_000_000


def angles(*found: float) -> JointAngles:
    return JointAngles(*found)


@pytest.mark.parametrize("step_ms", [2, 10, 20, 50])
def test_rate_is_that_of_25_ms_or_half_a_frame_ago(step_ms: int) -> None:
    """The rate is that of 25 ms, or half a frame period if longer, before the newest frame."""
    follower, off = AngleRates(), []
    late_s = max(25, step_ms / 2) * 1e-3
    for t_ms in range(0, 2000, step_ms):
        t_s = t_ms * 1e-3
        found = follower.update(
            t_ms * MS,
            "knee",
            angles(np.sin(3 * t_s), 0.2 * np.sin(3 * t_s), -0.5 * t_s),
            gimbal=False,
        )
        if t_ms >= 100:
            assert found is not None
            assert found.rotation == pytest.approx(-0.5)
            assert found.adduction == pytest.approx(0.2 * found.flexion)
            off.append(found.flexion - 3 * np.cos(3 * (t_s - late_s)))
    assert np.max(np.abs(off)) < 0.1


def test_rates_are_continuous_across_half_a_turn() -> None:
    follower = AngleRates()
    follower.update(0, "knee", angles(np.pi - 0.01, 0.0, -np.pi + 0.02), gimbal=False)
    found = follower.update(10 * MS, "knee", angles(-np.pi + 0.01, 0.0, np.pi - 0.02), gimbal=False)
    assert found == pytest.approx((2.0, 0.0, -4.0))


def test_rate_is_unknown_at_start_gap_gimbal_lock_and_unknown_angle() -> None:
    follower = AngleRates()
    assert follower.update(0, "knee", angles(0.0, 0.0, 0.0), gimbal=False) is None
    assert follower.update(200 * MS, "knee", angles(1.0, 0.0, 0.0), gimbal=False) is None
    assert follower.update(210 * MS, "knee", angles(1.0, 0.0, 0.0), gimbal=True) is None
    assert follower.update(220 * MS, "knee", angles(1.0, 0.0, 0.0), gimbal=False) is None
    assert follower.update(230 * MS, "knee", None, gimbal=False) is None
    assert follower.update(240 * MS, "knee", angles(1.0, 0.0, 0.0), gimbal=False) is None
    assert follower.update(250 * MS, "knee", angles(1.01, 0.0, 0.0), gimbal=False) is not None
