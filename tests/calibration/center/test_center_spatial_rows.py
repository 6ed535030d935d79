"""Every spatial row of the joint center table keeps its goal, on the code that prints it."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment
from bench.joint_center_rows.b_spatial import EXPERIMENTS


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_every_spatial_figure_keeps_its_goal(experiment: Experiment) -> None:
    figures = experiment.run(DATA)
    assert figures
    assert [figure for figure in figures if not figure.kept] == []
