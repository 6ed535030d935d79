"""Instruction counts of a frame: which instructions count, and that no count has grown."""

from __future__ import annotations

import json
import sys

import pytest

from bench.experiments.speed import instruction_counts
from bench.experiments.speed.instruction_counts import PYTHON, count_instructions


def square(value: int) -> int:
    return value * value


def test_instructions_are_counted_exactly() -> None:
    once = count_instructions(lambda: square(3))
    twice = count_instructions(lambda: (square(3), square(4)))
    assert 0 < once < twice
    assert {count_instructions(lambda: square(3)) for _ in range(5)} == {once}


def test_functions_of_libraries_are_not_counted() -> None:
    plain = count_instructions(lambda: None)
    encoder = json.JSONEncoder(indent=1)
    assert count_instructions(lambda: encoder.encode([1, 2, 3])) < plain + 20


@pytest.mark.experiment
@pytest.mark.skipif(sys.version_info[:2] != PYTHON, reason="counts are those of Python 3.11")
def test_no_part_of_the_path_of_a_frame_needs_more_instructions() -> None:
    (experiment,) = instruction_counts.EXPERIMENTS
    results = instruction_counts.counted_rows()
    assert {result.name for result in results} == set(instruction_counts.KNOWN)
    assert experiment.unexpected(results) == []
