"""Restarts of inverse kinematics that ended in a local minimum."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.kinematics.chains import (
    ChainModel,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    rest_state,
)
from jointfit_daemon.kinematics.inverse_kinematics import (
    IkOptions,
    IkResult,
    restart_local_minima,
    solve_frames,
    tracking_error,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

OPTIONS = IkOptions(limit_m2=1.0)


def chain() -> ChainModel:
    """Return a chain of two hinges with one marker on the last segment.

    The elbow can bend to two sides with the same marker position; the limits forbid one side.
    """
    rng = np.random.default_rng(0)
    segments = (
        Segment("base"),
        Segment("arm", "base", Joint("hinge", (0.0, 0.0, -0.3))),
        Segment("hand", "arm", Joint("hinge", (0.0, 0.0, -0.3), limits=(0.0, 2.5))),
    )
    base = [Marker(f"B{k}", "base", tuple(at)) for k, at in enumerate(rng.normal(0, 0.1, (4, 3)))]
    return ChainModel(segments, (*base, Marker("H", "hand", (0.0, 0.0, -0.3))), "arm")


@cache
def trial(count: int = 40) -> Array:
    model, t = chain(), np.linspace(0.0, 4.0, count)
    move = 0.3 * np.sin(t[:, None] + np.linspace(0.0, 2.0, model.nq))
    move[:, -1] = 1.2 + 0.4 * np.sin(t)
    y = marker_positions(model, apply_step(model, rest_state(model, count), move))
    return y + np.random.default_rng(1).normal(0.0, 0.002, y.shape)


def stuck(at: slice) -> tuple[IkResult, IkResult]:
    """Return the correct solution, and a solution that is far from the minimum at instants `at`."""
    model, y = chain(), trial()
    right = solve_frames(model, y, options=OPTIONS)
    step = np.zeros((len(y), model.nq))
    step[at, -2:] = 1.2, -2.4
    state = apply_step(model, right.state, step)
    return right, replace(right, state=state, residuals=marker_positions(model, state) - y)


@pytest.mark.parametrize("at", [slice(21, 22), slice(10, 30), slice(0, 40)])
def test_local_minima_of_an_instant_a_part_or_a_whole_trial_are_corrected(at: slice) -> None:
    right, wrong = stuck(at)
    assert tracking_error(wrong.residuals[at]) > 2.0 * tracking_error(right.residuals[at])
    found, improved = restart_local_minima(chain(), trial(), None, wrong, OPTIONS)
    assert tracking_error(found.residuals) < 1.02 * tracking_error(right.residuals)
    assert improved[at].all()


def test_a_good_solution_remains_unchanged() -> None:
    right = solve_frames(chain(), trial(), options=OPTIONS)
    found, improved = restart_local_minima(chain(), trial(), None, right, OPTIONS)
    assert not improved.any()
    np.testing.assert_array_equal(found.residuals, right.residuals)


def test_the_given_solution_is_not_overwritten() -> None:
    _, wrong = stuck(slice(10, 30))
    before = wrong.residuals.copy()
    restart_local_minima(chain(), trial(), None, wrong, OPTIONS)
    np.testing.assert_array_equal(wrong.residuals, before)
