"""A counter is unwrapped to the nearest count, or by the host time after a silence."""

from __future__ import annotations

import pytest

from jointfit_daemon.timing.clock._counter_wrap import unwrap
from jointfit_daemon.timing.clock._device_time import CounterTime
from jointfit_daemon.timing.clock._minimum_delay import MinimumDelayFilter


@pytest.mark.parametrize(
    ("raw", "last", "elapsed_ns", "expected"),
    [
        (5, 3, 0, 5),
        (3, 5, 0, 3),  # an older reading
        (2, 254, 0, 258),
        (254, 258, 0, 254),
        (127, 0, 0, 127),
        (128, 0, 0, -128),  # a change of half a turn counts as an older reading
        (0, 0, 256, 256),
        (5, 3, 64, 5),  # after a quarter turn, the nearest count is used
        (3, 5, 64, 3),
        (3, 5, 65, 3),  # after more than a quarter turn, host time determines the count
        (3, 5, 127, 259),
        (5, 3, 2 * 256 + 2, 2 * 256 + 5),
        (5, 3, 2 * 256 + 129, 2 * 256 + 5),
        (5, 3, 2 * 256 + 131, 3 * 256 + 5),
        (200, 100, 100, 200),
    ],
)
def test_a_count_of_eight_bits_is_unwrapped(
    raw: int, last: int, elapsed_ns: int, expected: int
) -> None:
    assert unwrap(raw, last, 256, elapsed_ns, 256) == expected


def test_a_count_falls_by_one_turn_at_most() -> None:
    assert unwrap(200, 1000, 256, 10**6, 10**9) == 968
    assert unwrap(7, 900, None, 0, 0) == 7


@pytest.mark.parametrize(("elapsed", "unwrapped"), [(116, 316), (146, 316), (40, None)])
def test_the_first_wrap_of_a_counter_needs_an_elapsed_time_that_fits(
    elapsed: int, unwrapped: int | None
) -> None:
    period_ns = 10_000_000
    reader, line = CounterTime(period_ns), MinimumDelayFilter()
    assert reader.feed(None, 200, 0, line) == 200 * period_ns
    found = reader.feed(None, 60, elapsed * period_ns, line)
    assert found == (None if unwrapped is None else unwrapped * period_ns)
