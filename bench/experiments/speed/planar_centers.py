"""Cost of planar centers of rotation, one frame at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import per_item, speed_experiment
from jointfit_daemon.center_of_rotation.planar import RunningCircle

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

FRAMES = 2000


def _swing() -> list[list[float]]:
    turned = 0.6 * np.sin(0.05 * np.arange(FRAMES))
    points = 0.3 * np.stack((np.cos(turned), np.sin(turned)), axis=-1)
    noisy: list[list[float]] = (
        points + np.random.default_rng(0).normal(0, 0.002, (FRAMES, 2))
    ).tolist()
    return noisy


def circle_rows(quick: bool) -> list[Result]:
    points = _swing()

    def feeding(*, robust: bool, window: int | None = None) -> Callable[[], Callable[[], object]]:
        def prepare() -> Callable[[], object]:
            running = RunningCircle(robust=robust, window=window)

            def run() -> None:
                for x, y in points:
                    running.feed(x, y)
                    running.circle()

            return run

        return prepare

    def told() -> Callable[[], object]:
        running = RunningCircle()
        for x, y in points[:200]:
            running.feed(x, y)
        return lambda: [running.estimate() for _ in range(200)]

    rows = [
        per_item(f"center: one frame{name}", prepare, items=FRAMES, goal_us=20, quick=quick)
        for name, prepare in (
            ("", feeding(robust=False)),
            (", weighted", feeding(robust=True)),
            (", window", feeding(robust=False, window=300)),
        )
    ]
    return [
        *rows,
        per_item("center: error and acceptance", told, items=200, goal_us=60, quick=quick),
    ]


EXPERIMENTS = (
    speed_experiment(
        "planar-center-time",
        "Planar centre of rotation, frame by frame",
        circle_rows,
    ),
)
