"""Statistics of the delays of the last minute, compared with NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.timing.clock._delay_statistics import HALF_NS, DelayStatistics, bin_of

S = 1_000_000_000


@given(st.lists(st.integers(1, 10**11), min_size=200, max_size=400))
def test_percentiles_are_those_of_the_samples(delays: list[int]) -> None:
    minute = DelayStatistics()
    for k, delay in enumerate(delays):
        minute.feed(k * 1000, delay)
    found = minute.delays
    assert found is not None
    assert found.max_ns == max(delays)
    for value, share in ((found.p50_ns, 0.5), (found.p99_ns, 0.99)):
        low, high = np.quantile(delays, [share - 0.01, min(1.0, share + 0.01)])
        assert 0.88 * low - 2048 <= value <= 1.13 * high + 2048


@given(st.integers(-(10**9), 10**14), st.integers(0, 10**12))
def test_bins_are_in_order(delay: int, more: int) -> None:
    assert bin_of(delay) <= bin_of(delay + more)


def test_every_delay_has_a_bin_even_a_day_or_a_negative_one() -> None:
    minute = DelayStatistics()
    for delay in (86_400 * S, -5):
        minute.feed(0, delay)
    assert bin_of(-5) == bin_of(0) == 0
    assert minute.delays is not None
    assert minute.delays.max_ns == 86_400 * S


def test_delays_older_than_a_minute_are_excluded() -> None:
    minute = DelayStatistics()
    minute.feed(0, 10 * S)
    for k in range(1, 75):
        minute.feed(k * S, S // 1000)
    found = minute.delays
    assert found is not None
    assert found.max_ns == S // 1000


def test_rate_after_a_long_silence_uses_later_samples_only() -> None:
    minute = DelayStatistics()
    for start in (0, 3 * HALF_NS):
        for k in range(101):
            minute.feed(start + k * S // 100, 0)
    assert minute.rate_hz == pytest.approx(100)


def test_delay_statistics_without_samples_are_unknown() -> None:
    minute = DelayStatistics()
    assert minute.delays is None
    minute.feed(5, 7)
    assert minute.rate_hz is None
