"""The ten-hour memory experiment in short form, and its detection of a leak."""

from __future__ import annotations

import pytest

from bench.experiments.timing.memory import Held, growth, held, watch

KIB = 1024
FULL_H = 0.06
"""Time after which two buffers of the timing are full, h: the arrivals of the last minute, and the
clock echoes (request and answer of the camera server) of the last two minutes."""


@pytest.mark.experiment
def test_core_memory_does_not_grow_in_a_quarter_of_an_hour() -> None:
    looks, samples, states = watch(0.25, 30)
    sizes = [look.size for look in looks if look.hours > FULL_H]
    assert samples > 20_000
    assert states > 4_000
    assert len(sizes) > 4
    assert max(sizes) - min(sizes) < 16 * KIB  # a leak of 8 bytes per sample would be 170 KiB


def test_memory_experiment_measures_size_and_growth() -> None:
    kept: list[float] = []
    before = held(kept, 1.0)
    kept += [k + 0.5 for k in range(1000)]
    after = held(kept, 2.0)
    assert after.objects - before.objects == 1000
    assert 30_000 < after.size - before.size < 40_000
    assert growth([before, after, Held(3.0, 2 * after.size - before.size, 0)]) > 30_000
