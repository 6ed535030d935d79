"""Streaming sphere fit: costs of a frame of one joint, and of an estimate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import per_item, speed_experiment
from bench.subjects.simulated_joints import ball_turns, carried
from jointfit_daemon.center_of_rotation.spatial import RunningSphere

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from bench.framework.experiment import Result

FRAMES = 1000


def frames() -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(5)
    paths = carried(ball_turns(rng, 45.0, FRAMES))
    return list(paths + rng.normal(0, 1e-3, paths.shape))


def fill(stream: RunningSphere, points: list[NDArray[np.float64]]) -> None:
    for frame in points:
        stream.feed(frame)


def feeding(watched: bool) -> Callable[[], Callable[[], object]]:
    points = frames()

    def work() -> Callable[[], object]:
        stream = RunningSphere(4, forgetting=0.999)
        fill(stream, points[:50])
        if watched:  # after an estimate, `feed` detects markers off their spheres
            stream.estimate()
        return lambda: fill(stream, points)

    return work


def answering() -> Callable[[], object]:
    stream = RunningSphere(4)
    fill(stream, frames())
    return lambda: [stream.estimate() for _ in range(10)]


def sphere_rows(quick: bool) -> list[Result]:
    n = FRAMES
    return [
        per_item("sphere: a frame of 4 markers", feeding(False), items=n, goal_us=20, quick=quick),
        per_item(
            "sphere: a frame of 4 markers, with outlier check",
            feeding(True),
            items=n,
            goal_us=20,
            quick=quick,
        ),
        per_item("sphere: an estimate", answering, items=10, goal_us=3000, quick=quick),
    ]


EXPERIMENTS = (
    speed_experiment(
        "spatial-center-time",
        "Spatial centre of rotation, frame by frame",
        sphere_rows,
    ),
)
