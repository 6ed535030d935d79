"""Recorded trials replayed as bytes through the daemon, compared with the offline evaluation.

The expected value of each error is the error of the offline evaluation at the same frames. The
tolerance is 0.1°.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from bench.experiments.fusion.knee_segments import NAMES
from bench.framework.experiment import Experiment, Result, near
from bench.framework.material import KNEE
from bench.rigs import recorded_trial
from bench.subjects.recorded_knee import FOLDER

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from bench.rigs.recorded_trial import Played
    from jointfit_daemon.limb_model import Method

METHODS: tuple[Method, ...] = ("mean", "patent12", "patent6", "anchored")
WALKERS: tuple[Method, ...] = ("patent12", "patent6", "anchored")
ALLOWED_DEG = 0.1
REPEATED_DEG = 0.01
"""Largest accepted angle, deg, between a segment in ``pose`` and the result of the patent's
regression, which is computed again from other messages (`Played.repeated_deg`)."""


@cache
def _played(data: Path) -> dict[tuple[str, Method], Played]:
    """Return the runs of both experiments, which take three minutes of real time."""
    return recorded_trial.run(data, METHODS, WALKERS)


def _beside(trial: str, methods: tuple[Method, ...]) -> Callable[[Path], list[Result]]:
    def run(data: Path) -> list[Result]:
        figures = []
        for method in methods:
            live = _played(data)[trial, method]
            figures += [
                near(
                    f"{method}: {name}",
                    value,
                    expected,
                    ALLOWED_DEG,
                    note=f"offline {expected:.3f}",
                )
                for name, value, expected in zip(NAMES, live.errors, live.offline, strict=True)
            ]
            if live.repeated_deg is not None:
                label = f"{method}: pose against its steps on sensors/pose, largest"
                figures.append(Result(label, live.repeated_deg, REPEATED_DEG))
            share = live.frames / live.recorded
            figures.append(Result(f"{method}: share evaluated", share, 1.0, minimum=0.9, unit=""))
        return figures

    return run


LOAD = (
    "other processes of the machine delayed samples of this walk of 1.3 s, so fewer frames were "
    "evaluated"
)
EXPERIMENTS = (
    Experiment(
        "end-to-end-squats",
        "Errors of the daemon's pose messages in held-out squats, compared with the "
        "offline evaluation",
        _beside("squats", METHODS),
        KNEE,
        (FOLDER,),
        long=True,
    ),
    Experiment(
        "end-to-end-walking",
        "Errors of the daemon's pose messages in walking, trained on squats, compared with"
        " the offline evaluation",
        _beside("walking", WALKERS),
        KNEE,
        (FOLDER,),
        long=True,
        known_misses={"anchored: share evaluated": LOAD},
    ),
)
