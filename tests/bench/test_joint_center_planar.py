"""Every short experiment on planar joint centers meets its thresholds."""

from __future__ import annotations

import pytest

from bench.experiments.joint_center import planar, planar_oriented
from bench.framework.experiment import DATA, Experiment
from bench.subjects.planar_arcs import runs_on, share_covered

pytestmark = pytest.mark.experiment
EXPERIMENTS = (*planar.EXPERIMENTS, *planar_oriented.EXPERIMENTS)


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_planar_center_experiment_meets_its_thresholds(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    results = experiment.run(DATA)
    assert results
    assert experiment.unexpected(results) == []


@pytest.mark.parametrize(
    ("n", "arc", "noise"),
    [(100, 19, 0.002), (100, 90, 0.002), (30, 30, 0.002), (15, 45, 0.002), (60, 90, 0.02)],
)
def test_95_percent_ellipses_contain_the_true_center(n: int, arc: float, noise: float) -> None:
    found = runs_on(n, arc, noise, runs=4000, correlated=True)
    assert 0.93 <= share_covered(found, n) <= 0.97
