"""The published coordinate search finds the minimum of error functions with known minimum."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.calibration.marker_refinement import search
from jointfit_daemon.calibration.marker_refinement._coordinate_search import SearchSettings

START = np.zeros((2, 3))
FREE = np.ones((2, 3), dtype=np.bool_)
places = st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6).map(
    lambda v: np.array(v).reshape(2, 3)
)


def distance_to(goal: np.ndarray) -> object:
    return lambda positions: float(np.sqrt(np.mean((positions - goal) ** 2)))


@given(places)
def test_every_coordinate_comes_within_a_threshold_of_the_best(goal: np.ndarray) -> None:
    found = search(distance_to(goal), START, FREE)  # type: ignore[arg-type]
    assert np.abs(found.positions - goal).max() <= SearchSettings().threshold_m


@given(places)
def test_the_error_falls_with_every_accepted_step(goal: np.ndarray) -> None:
    found = search(distance_to(goal), START, FREE)  # type: ignore[arg-type]
    assert (np.diff(found.errors) < 0.0).all()
    assert found.runs >= len(found.errors)


@given(places)
def test_a_locked_coordinate_stays(goal: np.ndarray) -> None:
    free = FREE.copy()
    free[0, 1] = free[1, 2] = False
    found = search(distance_to(goal), START, free)  # type: ignore[arg-type]
    assert (found.positions[~free] == 0.0).all()
    off = np.abs(found.positions - goal)[free]
    assert off.max() <= SearchSettings().threshold_m


def test_a_step_is_kept_while_it_helps_and_halved_only_when_neither_way_does() -> None:
    """The step is halved only if neither direction reduces the error."""
    asked: list[float] = []

    def error(positions: np.ndarray) -> float:
        asked.append(round(float(positions[0, 0]), 6))
        return abs(float(positions[0, 0]) - 0.021)

    only = np.zeros((1, 3), dtype=np.bool_)
    only[0, 0] = True
    search(error, np.zeros((1, 3)), only, SearchSettings(0.008, 0.002))
    # The minimum is at 21 mm. Three steps of 8 mm reduce the error, the fourth step does not.
    there = [0, 8, 16, 24, 32]
    # No step of 8 mm reduces the error. Of the steps of 4 mm, only the step from 24 to 20 does.
    halved = [32, 16, 28, 20, 16]
    # No step of 4 mm or 2 mm from 20 reduces the error.
    ended = [24, 16, 22, 18]
    np.testing.assert_allclose(1000 * np.array(asked), there + halved + ended)
