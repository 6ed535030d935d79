"""CPU time of inverse kinematics: all frames at once, and frame by frame with covariance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.framework.experiment import DATA, Result
from bench.framework.measurement import per_item, speed_experiment
from bench.subjects.adult_lower_limbs import FOLDER, measured, oc4_lower
from bench.subjects.two_segments import swing, two_segments
from jointfit_daemon.kinematics.inverse_kinematics import LiveInverseKinematics, solve_frames

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel


def rows(quick: bool) -> list[Result]:
    small = two_segments()
    found = _of("two segments", small, swing(small, 150)[1], (50, 300), quick=quick)
    if (DATA / FOLDER).is_dir():
        leg = oc4_lower(DATA)
        y = measured(DATA, "walking1", leg)
        found += _of("seven segments, 29 markers", leg, y, (400, 1200), quick=quick)
    return found


def _of(
    name: str, model: ChainModel, y: Array, goals_us: tuple[int, int], *, quick: bool
) -> list[Result]:
    batch_us, live_us = goals_us

    def batch() -> Callable[[], object]:
        return lambda: solve_frames(model, y)

    def live() -> Callable[[], object]:
        following = LiveInverseKinematics(model)
        following.feed(y[0])  # the first frame has no previous pose
        return lambda: [following.feed(row) for row in y[1:]]

    count = len(y)
    return [
        per_item(f"ik: {name}, batch", batch, items=count, goal_us=batch_us, quick=quick),
        per_item(f"ik: {name}, live", live, items=count - 1, goal_us=live_us, quick=quick),
    ]


EXPERIMENTS = (
    speed_experiment(
        "inverse-kinematics-frame-time",
        "Inverse kinematics, per frame",
        rows,
    ),
)
