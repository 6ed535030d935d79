"""Every row of the fusion table that is short enough meets its goal."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment, find_experiments

EXPERIMENTS = find_experiments("fusion_rows")


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_every_figure_of_fusion_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    assert [figure for figure in experiment.run(DATA) if not figure.kept] == []


def test_rows_of_fusion_have_names_of_their_own() -> None:
    names = [experiment.id for experiment in EXPERIMENTS]
    assert len(set(names)) == len(names)
    assert {"F-1", "F-2", "F-3", "F-4", "F-5", "F-6", "E-1"} <= {*names}
