"""Every row of the timing table meets its goal, on the same code that prints the table."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment, find_experiments

EXPERIMENTS = find_experiments("timing_rows")


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_every_figure_of_time_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    figures = experiment.run(DATA)
    assert figures
    assert [figure for figure in figures if not figure.kept] == []


def test_rows_of_time_have_names_of_their_own() -> None:
    names = [experiment.id for experiment in EXPERIMENTS]
    assert len(set(names)) == len(names)
