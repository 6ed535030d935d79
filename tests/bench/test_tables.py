"""Every row of every table meets its goal, on the same code that prints the table."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment, find_experiments

TABLES = ("accuracy", "timing", "markers")
EXPERIMENTS = {name: find_experiments(f"{name}_rows") for name in TABLES}
SHORT = [(name, row) for name, rows in EXPERIMENTS.items() for row in rows if not row.long]


@pytest.mark.timeout(180)
@pytest.mark.parametrize(
    "experiment", [row for _, row in SHORT], ids=[f"{name}-{row.id}" for name, row in SHORT]
)
def test_every_figure_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    figures = experiment.run(DATA)
    assert figures
    assert experiment.missed(figures) == []


@pytest.mark.parametrize("table", TABLES)
def test_rows_have_names_of_their_own(table: str) -> None:
    names = [experiment.id for experiment in EXPERIMENTS[table]]
    assert names
    assert len(set(names)) == len(names)
