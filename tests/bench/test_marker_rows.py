"""Every row of the table of markers meets its goal, on the same code that prints the table."""

from __future__ import annotations

import pytest

from bench.experiment import DATA, Experiment, find_experiments

EXPERIMENTS = find_experiments("markers_rows")
SPEED = "D-12"
BUSY = 4.0
"""A machine that does other things, too, may take so many times the goal."""


@pytest.mark.timeout(60)
@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_every_row_of_markers_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    figures = experiment.run(DATA)
    assert figures
    slack = BUSY if experiment.id == SPEED else 1.0
    slow = [f for f in figures if f.unit.startswith("µs") and not f.value <= slack * f.goal]
    wrong = [f for f in figures if not f.unit.startswith("µs") and not f.kept]
    assert slow == []
    assert wrong == []


def test_rows_of_markers_have_names_of_their_own() -> None:
    names = [experiment.id for experiment in EXPERIMENTS]
    assert len(set(names)) == len(names)
    assert {"D-1", "D-2", "D-3", "D-12"} <= {*names}
