"""Growth exponents of costs are estimated independently of a fixed cost."""

from __future__ import annotations

import pytest

from bench.framework.exponents import growth_exponent, log_slope

SIZES = (1, 2, 4, 8, 16, 32)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.3, 2.0])
@pytest.mark.parametrize("fixed", [0.0, 70.0])
def test_the_exponent_of_a_power_is_found_whatever_the_fixed_cost(
    exponent: float, fixed: float
) -> None:
    found = growth_exponent(SIZES, [fixed + 40.0 * size**exponent for size in SIZES])
    assert found.value == pytest.approx(exponent, abs=1e-9)
    assert found.half_width < 1e-6


def test_a_quadratic_part_exceeds_the_threshold_and_noise_widens_the_interval() -> None:
    quadratic = growth_exponent(SIZES, [78.0 + 43.0 * n + 0.65 * n * n for n in SIZES])
    assert quadratic.value > 1.05
    noisy = growth_exponent(SIZES, [100.0, 145.0, 230.0, 420.0, 770.0, 1500.0])
    assert abs(noisy.value - 1.0) < noisy.half_width < 0.2


def test_a_cost_that_does_not_increase_has_no_exponent() -> None:
    with pytest.raises(ValueError, match="do not increase"):
        growth_exponent(SIZES, [5.0, 6.0, 6.0, 8.0, 9.0, 10.0])


def test_a_constant_ratio_has_the_slope_0() -> None:
    assert log_slope((300, 3_000, 30_000, 300_000), [1.01] * 4).value == pytest.approx(0.0)
