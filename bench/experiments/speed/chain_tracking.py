"""Chain model in the daemon: cost of a published camera frame."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.measurement import per_item, speed_experiment
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.models import load_model
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline.chain_tracking import ChainTracker
from jointfit_simulators.sample import write_sample

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result
    from jointfit_daemon.files.models import LoadedModel

RATE_HZ = 10
"""Default of ``[mqtt] chain_hz``."""
_TURNS, _NO_BODIES = np.zeros((0, 4)), np.zeros((0, 3))


@cache
def _sample() -> tuple[dict[str, LoadedModel], list[MocapFrame]]:
    """Return models of the sample data by name, and 8 s of walking at 10 Hz."""
    with TemporaryDirectory(prefix="jointfit-bench-") as folder:
        path = Path(folder)
        write_sample(path)
        models = {
            "TOML, default coordinates": load_model(path / "leg.toml"),
            "OpenSim, coordinates of the file": load_model(path / "leg.osim"),
        }
        trial = read_marker_trial(path / "walking.trc").trajectories
        points = read_marker_trial(path / "walking.trc").points(trial.names)

    layout = MocapLayout(trial.names, ())
    every = round(trial.rate_hz / RATE_HZ)
    frames = [
        MocapFrame(0, k, None, layout, row, _NO_BODIES, _TURNS)
        for k, row in enumerate(points[::every])
    ]
    return models, frames


def _track(model: LoadedModel, frames: list[MocapFrame]) -> Callable[[], object]:
    tracker = ChainTracker(model, RATE_HZ)
    period_ns = round(1e9 / RATE_HZ)
    tracker.add_frame(0, frames[0])  # the first frame has no frame before

    def run() -> None:
        for k, frame in enumerate(frames[1:], start=1):
            tracker.add_frame(k * period_ns, frame)

    return run


def rows(quick: bool) -> list[Result]:
    models, frames = _sample()
    return [
        per_item(
            f"chain model: one published frame, {name}",
            partial(_track, model, frames),
            items=len(frames) - 1,
            goal_us=goal_us,
            quick=quick,
            note="4 segments, 16 markers, 10 Hz",
        )
        for (name, model), goal_us in zip(models.items(), (3000, 6000), strict=True)
    ]


EXPERIMENTS = (
    speed_experiment(
        "chain-tracking-time", "Inverse kinematics of a chain model in the daemon", rows
    ),
)
