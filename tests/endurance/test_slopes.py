"""A leak is found in the noise of a run; a run without one has the slope zero."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.endurance.slopes import slope_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

SAMPLES = np.linspace(0.0, 5e6, 400)


def noise(seed: int) -> NDArray[np.float64]:
    """Return values of which each depends on the one before, as the memory of a process does."""
    draws, found = np.random.default_rng(seed).normal(size=len(SAMPLES)), np.zeros(len(SAMPLES))
    for k in range(1, len(found)):
        found[k] = 0.5 * found[k - 1] + draws[k]
    return found


def test_about_one_run_in_twenty_without_a_leak_has_a_slope() -> None:
    wrong = sum(not slope_of(SAMPLES, noise(seed), 1).is_zero for seed in range(60))
    assert 0 < wrong < 9


def test_about_one_run_in_twenty_has_a_slope_in_any_of_eight_quantities() -> None:
    runs = (range(8 * run, 8 * run + 8) for run in range(40))
    wrong = sum(
        any(not slope_of(SAMPLES, noise(1000 + seed), 8).is_zero for seed in run) for run in runs
    )
    assert 0 < wrong < 7


def test_other_programs_that_disturb_some_values_are_no_leak() -> None:
    disturbed = np.where(np.arange(len(SAMPLES)) % 3 == 0, SAMPLES / 1e5, 0.0)
    assert slope_of(SAMPLES, noise(3) + disturbed, 1).is_zero


def test_a_leak_below_the_noise_is_found_with_its_size() -> None:
    found = slope_of(SAMPLES, noise(1) + 0.8 * SAMPLES / 1e6, 1)
    assert not found.is_zero
    assert found.per_million == pytest.approx(0.8, abs=found.half_width)


def test_memory_that_grows_at_the_start_only_is_no_leak() -> None:
    caches = 50.0 * np.minimum(SAMPLES / 5e5, 1.0)
    assert slope_of(SAMPLES, noise(2) + caches, 1).is_zero


def test_a_constant_has_no_slope() -> None:
    found = slope_of(SAMPLES, np.full(len(SAMPLES), 12.0), 1)
    assert (found.per_million, found.half_width, found.mean) == (0.0, 0.0, 12.0)
    assert found.is_zero


def test_a_short_run_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 24"):
        slope_of(SAMPLES[:20], SAMPLES[:20], 1)
