"""Rows E2E-*: the recorded trials as bytes through the real daemon give the offline figures.

Every figure stands beside the offline figure that this bench measures on the same frames, which is
its expected value; a tenth of a degree is allowed.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from bench.experiments.fusion.knee_segments import NAMES, KneeModels, Squats
from bench.framework.experiment import Experiment, Figure, near
from bench.rigs import recorded_trial
from bench.subjects.recorded_knee import FOLDER, load

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from bench.rigs.recorded_trial import Played
    from jointfit_daemon.limb_model import Method

METHODS: tuple[Method, ...] = ("mean", "patent12", "patent6", "anchored")
WALKERS: tuple[Method, ...] = ("patent12", "anchored")
ALLOWED_DEG = 0.1


@cache
def _played(data: Path) -> dict[tuple[str, Method], Played]:
    """Return all runs; they share one half minute of real time."""
    return recorded_trial.run(data, METHODS, WALKERS)


def _beside(trial: str, methods: tuple[Method, ...]) -> Callable[[Path], list[Figure]]:
    def run(data: Path) -> list[Figure]:
        knee = Squats(data)
        held = knee.held if trial == "squats" else load(data, "walking1")
        figures = []
        for method in methods:
            live = _played(data)[trial, method]
            # frames for which this machine was too busy to deliver in time are judged by neither
            same = live.of(held)
            models = KneeModels(method, [knee.training])
            offline = knee.judge.errors(models.predict(same), same)
            figures += [
                near(f"{method}: {name} (offline {expected:.3f})", said, expected, ALLOWED_DEG)
                for name, said, expected in zip(NAMES, live.errors, offline, strict=True)
            ]
            share = live.frames / len(held)
            figures.append(Figure(f"{method}: share judged", share, 1.0, least=0.9, unit=""))
        return figures

    return run


EXPERIMENTS = (
    Experiment("E2E-squats", "squats hold-out, bytes to MQTT", _beside("squats", METHODS),
               (FOLDER,), long=True),
    Experiment("E2E-walk", "walking, bytes to MQTT, trained on squats",
               _beside("walking", WALKERS), (FOLDER,), long=True),
)  # fmt: skip
