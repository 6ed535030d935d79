"""Every short experiment meets its thresholds, and every experiment has committed results."""

from __future__ import annotations

import re

import pytest

from bench.framework import storage
from bench.framework.experiment import DATA, Experiment, Result, find_experiments, near
from bench.framework.material import SEEDED

EXPERIMENTS = {experiment.id: experiment for experiment in find_experiments()}
SHORT = [e for e in EXPERIMENTS.values() if not e.long and e.topic not in {"speed", "joint_center"}]
SEVERAL = re.compile(r"[0-9]+ simulated (subjects|sensors)|(five|eight) assignments")
"""Pattern of descriptions of data sets with several simulated subjects or sensors, or with several
assignments of filter errors to sensors."""
COUNTED = {
    "healthy-sensors-simulated", "healthy-sensors-after-squats", "healthy-sensors-after-walking",
    "online-learning-wrong-cameras",
}  # fmt: skip
"""Experiments that count events over all subjects. Their tables have no median over subjects."""
WORDS = re.compile(r"[a-z]+[0-9]*(-[a-z]+)+")  # names of devices end with digits


@pytest.mark.experiment
@pytest.mark.parametrize("experiment", SHORT, ids=lambda e: f"{e.topic}-{e.id}")
def test_short_experiment_meets_its_thresholds(experiment: Experiment) -> None:
    reason = experiment.missing()
    if reason is not None:
        pytest.skip(reason)
    results = experiment.run(DATA)
    assert results
    assert experiment.unexpected(results, shared_machine=True) == []
    if not experiment.timed:  # times of a loaded machine may miss thresholds by a known factor
        missed = {result.name for result in results if not result.met}
        assert set(experiment.known_misses) == missed


def test_experiment_ids_are_words_and_unique() -> None:
    found = [experiment.id for experiment in find_experiments()]
    assert len(set(found)) == len(found) > 100
    assert [name for name in found if not WORDS.fullmatch(name)] == []


def test_every_experiment_has_committed_results_and_every_result_an_experiment() -> None:
    stored = {path.stem for path in storage.RESULTS.glob("*.json")} - {storage.MACHINE}
    assert stored == set(EXPERIMENTS)


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=lambda e: e.id)
def test_committed_results_describe_their_experiment(experiment: Experiment) -> None:
    content = storage.load(experiment.id)
    results = storage.results_of(content)
    assert results
    assert storage.to_json(experiment, results) == content
    assert {r.name for r in results if not r.met} == set(experiment.known_misses)


@pytest.mark.parametrize(
    "experiment",
    [e for e in EXPERIMENTS.values() if SEVERAL.search(e.material.subjects) if e.id not in COUNTED],
    ids=lambda e: e.id,
)
def test_table_of_several_subjects_or_deals_has_median_and_extreme(experiment: Experiment) -> None:
    """A deal is one assignment of filter errors to sensors."""
    results = storage.results_of(storage.load(experiment.id))
    text = " ".join([experiment.title, *(f"{r.name} {r.note}" for r in results)])
    assert "median" in text
    assert re.search("worst|smallest|largest", text)


def test_rounding_of_a_stored_value_does_not_change_whether_it_meets_its_threshold() -> None:
    experiment = EXPERIMENTS["all-methods-simulated-subjects"]
    missed, met = Result("x", 0.62961, minimum=0.63), Result("y", 0.63012, minimum=0.63)
    stored = storage.to_json(experiment, [missed, met])
    assert [each["value"] for each in stored["results"]] == [0.62961, 0.63]
    assert [each.met for each in storage.results_of(stored)] == [False, True]


def test_result_outside_its_thresholds_is_not_met() -> None:
    assert Result("x", 1.0, maximum=1.0).met
    assert not Result("x", 1.01, maximum=1.0).met
    assert not Result("x", float("nan"), maximum=1.0).met
    assert not near("x", 2.0, 1.0, 0.1).met
    assert Result("x", 0.98, maximum=float("inf"), minimum=0.97).threshold_text == "≥ 0.97"


def test_only_times_may_be_longer_on_a_shared_machine() -> None:
    late = [Result("time", 3.9, maximum=1.0), Result("nothing", float("nan"), maximum=1.0)]
    steady = Experiment("x", "x", lambda _: late, SEEDED)
    timed = Experiment("x", "x", lambda _: late, SEEDED, timed=True)
    assert steady.unexpected(late, shared_machine=True) == late
    assert timed.unexpected(late, shared_machine=True) == late[1:]
    assert timed.unexpected(late) == late
    known = Experiment("x", "x", lambda _: late, SEEDED, known_misses={"time": "a reason"})
    assert known.unexpected(late) == late[1:]
