"""Cost of orientations that the gateway computes from raw bytes of an Xbus device."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import per_item, speed_experiment
from bench.subjects import raw_imu_trials
from jointfit_daemon.model import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500


def _work(count: int) -> Callable[[], object]:
    rng = np.random.default_rng(8)
    rate, force = rng.normal(size=(2, N, 3))
    felt = (rate, force + np.array((0.0, 0.0, 9.81)), rng.normal(size=(N, 3)))[:count]
    chunks = [Chunk(k * 1000, data) for k, data in enumerate(raw_imu_trials.messages(felt))]
    decoder = raw_imu_trials.decoder(magnetometer=count > 2)
    return lambda: [decoder.feed(chunk) for chunk in chunks]


def rows(quick: bool) -> list[Result]:
    if find_spec("vqf") is None:
        return []
    return [
        per_item(
            f"raw xbus: bytes to oriented sample, {kind}",
            lambda count=count: _work(count),  # type: ignore[misc] # the value in this turn
            items=N,
            goal_us=60,
            quick=quick,
            note="filter included",
        )
        for kind, count in (("gyr + acc", 2), ("gyr + acc + mag", 3))
    ]


EXPERIMENTS = (
    speed_experiment(
        "gateway-orientation-time",
        "Orientation filter on the gateway",
        rows,
    ),
)
