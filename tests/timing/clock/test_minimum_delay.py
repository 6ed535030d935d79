"""Minimum-delay line, compared with an exhaustive search; and unwrapping of counters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.timing.clock._counter_wrap import unwrap
from jointfit_daemon.timing.clock._feasible_line import lower_hull, straddling_edge
from jointfit_daemon.timing.clock._minimum_delay import MinimumDelayFilter

MS = 1_000_000
S = 1_000_000_000
PERIOD = 10 * MS


@given(
    st.sampled_from([256, 1 << 16, 86_400_00]),
    st.lists(st.floats(0, 90), min_size=1, max_size=20),
    st.floats(-0.2, 0.2),
)
def test_unwrapping_undoes_wrapping(modulus: int, gaps: list[float], jitter: float) -> None:
    turn_ns = modulus * MS
    true = last = 5
    for gap in gaps:
        step = int(gap * modulus)
        true += step
        elapsed = max(0, step * MS + (int(jitter * turn_ns) if 4 * step > 2 * modulus else 0))
        if modulus / 2 <= step and 4 * elapsed <= turn_ns:
            continue
        last = unwrap(true % modulus, last, modulus, elapsed, turn_ns)
        assert last == true


def test_half_the_counter_range_separates_forward_from_reordered() -> None:
    assert unwrap(100, 256, 256, 0, S) == 356
    assert unwrap(127, 256, 256, 0, S) == 383
    assert unwrap(128, 256, 256, 0, S) == 128
    assert unwrap(250, 259, 256, 0, S) == 250
    assert unwrap(5, 1000, None, 0, 0) == 5


points = st.lists(
    st.tuples(st.integers(0, 10**6), st.integers(-1000, 1000)), min_size=2, max_size=30
)


def supports(a: tuple[int, int], b: tuple[int, int], cloud: list[tuple[int, int]]) -> bool:
    return all((b[0] - a[0]) * (y - a[1]) >= (b[1] - a[1]) * (u - a[0]) for u, y in cloud)


@given(points, st.randoms())
def test_the_edge_is_the_best_line_under_all_points(
    cloud: list[tuple[int, int]], shuffle: np.random.Generator
) -> None:
    if len({u for u, _ in cloud}) < 2:
        return
    mean = sum(u for u, _ in cloud) / len(cloud)
    a, b = straddling_edge(lower_hull(cloud), mean)
    shuffled = list(cloud)
    shuffle.shuffle(shuffled)
    assert lower_hull(shuffled) == lower_hull(cloud)

    def height(a: tuple[int, int], b: tuple[int, int]) -> float:
        return a[1] + (b[1] - a[1]) * (mean - a[0]) / (b[0] - a[0])

    assert supports(a, b, cloud)
    candidates = [
        height(p, q) for p in cloud for q in cloud if p[0] < q[0] and supports(p, q, cloud)
    ]
    assert height(a, b) == pytest.approx(max(candidates))


@given(points, st.data())
def test_delay_of_a_point_above_the_hull_does_not_change_the_line(
    cloud: list[tuple[int, int]], data: st.DataObject
) -> None:
    hull = lower_hull(cloud)
    off = [point for point in cloud if point not in hull]
    if off:
        u, y = data.draw(st.sampled_from(off))
        later = [(u, y + data.draw(st.integers(1, 1000))) if p == (u, y) else p for p in cloud]
        assert lower_hull(later) == hull


def test_the_minimum_delay_line_is_below_all_points_of_its_window() -> None:
    rng, envelope = np.random.default_rng(0), MinimumDelayFilter()
    for k in range(2000):
        y = int(rng.exponential(MS))
        envelope.feed(k * PERIOD, y)
        assert envelope.residual(k * PERIOD, y) >= -1e-3
