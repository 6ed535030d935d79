"""Every short row of the markers table meets its goal, on the same code that prints the table."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment, find_experiments

EXPERIMENTS = find_experiments("markers_rows")
TIMES = {"D-12"}
"""Of the machine, not of the code: judged by the bench alone."""
TESTED = [e for e in EXPERIMENTS if not e.long and e.id not in TIMES]


@pytest.mark.parametrize("experiment", TESTED, ids=lambda e: e.id)
def test_every_figure_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    figures = experiment.run(DATA)
    assert figures
    assert [figure for figure in figures if not figure.kept] == []


def test_rows_have_names_of_their_own() -> None:
    ids = {name for experiment in EXPERIMENTS for name in experiment.id.split(", ")}
    assert {f"D-{k}" for k in range(1, 14)} <= ids
