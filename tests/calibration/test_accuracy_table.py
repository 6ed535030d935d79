"""Every row of the accuracy table meets its goal, on the same code that prints the table."""

from __future__ import annotations

import pytest

from bench.accuracy_rows.e_simulated_limb import people
from bench.experiment import DATA, Experiment, Figure, find_experiments, near

EXPERIMENTS = find_experiments()


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if not e.long], ids=lambda e: e.id)
def test_every_figure_keeps_its_goal(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    figures = experiment.run(DATA)
    assert figures
    assert [figure for figure in figures if not figure.kept] == []


@pytest.mark.timeout(120)
def test_the_demos_person_is_measured_to_three_degrees() -> None:
    errors = {method: found[0] for method, found in people((1,)).items()}
    assert errors["anchored"].knee <= 3.0
    assert errors["anchored"].thigh < errors["patent12"].thigh < errors["mean"].thigh
    assert errors["anchored"].within_2_sd >= 0.9
    assert max(errors["anchored"].centers_mm.values()) < 25.0


def test_rows_have_names_of_their_own() -> None:
    names = [experiment.id for experiment in EXPERIMENTS]
    assert len(set(names)) == len(names)
    assert {"B-1", "B-2", "B-3", "B-4", "B-5", "B-6", "B-7", "B-12", "B-13", "B-15", "B-16"} <= {
        *names
    }


def test_a_figure_outside_its_goal_is_told() -> None:
    assert Figure("x", 1.0, goal=1.0).kept
    assert not Figure("x", 1.01, goal=1.0).kept
    assert not Figure("x", float("nan"), goal=1.0).kept
    assert not near("x", 2.0, 1.0, 0.1).kept
    assert Figure("x", 0.98, goal=float("inf"), least=0.97).goal_text == "≥ 0.97"
