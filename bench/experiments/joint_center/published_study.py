"""Replication of the published numerical experiment; table 1 as its legible digits."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from bench.framework.experiment import Experiment, Result, near
from bench.framework.material import SEEDED
from jointfit_daemon.center_of_rotation.study import PRINTED, PairMaps, StudySetup, run_study
from jointfit_daemon.tools.report.tables import NEAREST, correlations

if TYPE_CHECKING:
    from pathlib import Path

EXPECTED = {"α–σ": (0.98, 0.81), "r–σ": (1.00, 0.99), "r–α": (0.96, 0.91)}
"""From an independent implementation, at the clip that is nearest to the print."""


@cache
def _study() -> list[PairMaps]:
    return run_study(StudySetup())


def table_1(_: Path) -> list[Result]:
    figures: list[Result] = []
    for pair in _study():
        clip, (predicted, grid) = NEAREST[pair.name], EXPECTED[pair.name]
        first, second = correlations(pair, "grid", clip)
        shifted = correlations(pair, "shifted grid", clip)[1]
        at = "raw" if clip is None else f"≤ {100 * clip:g} cm"
        printed = PRINTED[pair.name]
        label = f"{pair.name}, {at}"
        figures += [
            near(f"{label}: prediction–analytic, printed {printed[0]}", first, predicted, 0.03, ""),
            near(f"{label}: analytic–grid, printed {printed[1]}", second, grid, 0.06, ""),
            near(f"{label}: analytic–shifted grid", shifted, grid, 0.06, ""),
        ]
    return figures


EXPERIMENTS = (
    Experiment(
        "published-error-maps",
        "Correlations of error maps: table 1 of the published numerical experiment",
        table_1,
        SEEDED,
        long=True,
    ),
)
