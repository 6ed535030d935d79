"""A leak is detected in spite of noise; without a leak, the interval of the slope contains zero."""

from __future__ import annotations

from math import isnan, nan
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.endurance.__main__ import largest_skew_ppm
from tests.endurance.slopes import ERROR, faults_of, outcomes_of, slope_of, warning_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

SAMPLES = np.linspace(0.0, 5e6, 400)


def noise(seed: int) -> NDArray[np.float64]:
    """Return noise in which each value depends on the previous value, like process memory."""
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


def results(**changed: Any) -> dict[str, Any]:
    """Return the results of a run without faults, or with changed values."""
    counters = {
        "received": 1000,
        "lost": 6,
        "late": 90,
        "dropped": 4,
        "unaccounted": 0,
        "reconnects": 0,
    }
    slopes = {"memory, MB": {"mean": 80.0, "per_million": -0.1, "half_width": 0.1}}
    sound = {"factor": 12, "worst_error_deg": 0.3, "counters": counters, "slopes": slopes}
    return sound | changed


def test_a_run_without_growth_has_no_fault() -> None:
    assert faults_of(results()) == []


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        ({"slopes": {"threads": {"per_million": 0.3, "half_width": 0.2}}}, "threads has a slope"),
        ({"slopes": {"skew": {"per_million": nan, "half_width": nan}}}, "skew: some values are un"),
        ({"worst_error_deg": 3.1}, f"{ERROR}: 3.1, limit 3"),
        ({"counters": results()["counters"] | {"unaccounted": 1}}, "1 samples have no outcome"),
        ({"counters": results()["counters"] | {"lost": 7}}, "smaller --factor than 12"),
    ],
)
def test_growth_wrong_poses_and_missing_samples_are_faults(
    changed: dict[str, Any], part: str
) -> None:
    (fault,) = faults_of(results(**changed))
    assert part in fault


def test_an_unknown_skew_of_any_sensor_is_not_replaced_by_that_of_another_sensor() -> None:
    assert largest_skew_ppm([1.0, -3.0, 2.0]) == -3.0
    assert isnan(largest_skew_ppm([None, 1.0]))
    assert isnan(largest_skew_ppm([1.0, None, -3.0]))


def test_a_run_below_ten_million_samples_is_too_short_to_judge_growth() -> None:
    assert "9999999 samples are too few" in warning_of(9_999_999)
    assert warning_of(10_000_000) == ""


def test_the_page_names_what_grew_in_the_stored_run() -> None:
    growing = results(slopes={"threads": {"per_million": 0.3, "half_width": 0.2}})
    assert "threads has a slope of +0.3 ± 0.2 per million" in outcomes_of(growing)
    assert "nothing grows" in outcomes_of(results())
