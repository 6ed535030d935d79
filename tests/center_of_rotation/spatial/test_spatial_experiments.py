"""The benchmark experiments on joint centers in space meet their targets."""

from __future__ import annotations

import pytest

from bench.experiments.joint_center.spatial import AT_20, AT_45, EXPERIMENTS, ball_joint
from bench.framework.experiment import DATA, Experiment

pytestmark = pytest.mark.experiment


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_spatial_experiment_meets_its_targets(experiment: Experiment) -> None:
    figures = experiment.run(DATA)
    assert figures
    assert [figure for figure in figures if not figure.met] == []


@pytest.mark.parametrize(("rom", "goals"), [(20.0, AT_20), (45.0, AT_45)])
def test_ball_joint_between_two_noisy_bodies_meets_its_targets_in_fewer_runs(
    rom: float, goals: tuple[float, ...]
) -> None:
    figures = ball_joint(rom, goals, runs=40)
    assert [figure for figure in figures if not figure.met] == []
