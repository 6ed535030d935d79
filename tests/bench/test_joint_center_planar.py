"""Every short row of the planar joint center table meets its goal."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment
from bench.joint_center_rows import a_planar, a_planar_oriented

EXPERIMENTS = (*a_planar.EXPERIMENTS, *a_planar_oriented.EXPERIMENTS)


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_every_figure_of_a_planar_center_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    figures = experiment.run(DATA)
    assert figures
    assert [figure for figure in figures if not figure.kept] == []
