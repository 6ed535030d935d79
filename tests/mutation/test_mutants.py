"""Mutants change only code that a test can observe, and the score has a confidence interval."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

import pytest

from tests.mutation.score import interval, stored_outcomes, table_of, text_of

if TYPE_CHECKING:
    from pathlib import Path

SOURCE = """
from typing import TYPE_CHECKING, TypeAlias
if TYPE_CHECKING:
    import numpy as np
Word: TypeAlias = int | str
def limited(value: int | None, *, most: "int | None" = 4) -> int | None:
    if value is not None and value <= most:
        return value + 1
    return None
"""


def test_mutants_change_the_code_and_no_annotation(tmp_path: Path) -> None:
    mutants = pytest.importorskip(
        "tests.mutation.mutants", reason="cosmic-ray is not installed: make mutation installs it"
    )
    path = tmp_path / "source.py"
    path.write_text(SOURCE, encoding="utf-8")
    found = mutants.mutants_of(path)
    changes = {mutant.change(mutant.source()) for mutant in found}
    assert ("return value + 1", "return value - 1") in changes
    assert (
        "if value is not None and value <= most:",
        "if value is not None and value < most:",
    ) in changes
    assert {mutant.line for mutant in found} == {6, 7, 8}
    for mutant in found:
        ast.parse(mutant.source())


def test_interval_holds_the_share_and_narrows() -> None:
    low, high = interval(90, 100)
    assert (low, high) == pytest.approx((0.826, 0.945), abs=0.001)  # Wilson 1927
    assert interval(900, 1000)[0] > low
    assert interval(10, 10)[1] == pytest.approx(1.0)


def test_the_score_as_drawn_counts_every_mutant_that_survived_the_first_run() -> None:
    outcomes = ["killed", "killed", "killed later", "equivalent", "removed", "survived"]
    mutants = [{"package": "timing", "outcome": outcome} for outcome in outcomes]
    row = table_of(mutants).splitlines()[-1]
    assert row == "| all | 6 | 2 | 33 | 10 to 70 | 1 | 1 | 1 | 1 | 75 |"
    text = text_of({"seed": 20, "drawn": 6, "mutants": mutants})
    assert text.splitlines()[0] == "The stored results contain 6 of the 6 mutants with seed 20."


def test_the_page_states_that_a_run_was_stopped() -> None:
    mutants = [{"package": "timing", "outcome": outcome} for outcome in ("killed", "")]
    text = text_of({"seed": 20, "drawn": 2, "mutants": mutants})
    assert text.startswith(
        "The stored results contain 1 of the 2 mutants with seed 20. The run was stopped"
    )
    assert text.splitlines()[-1].startswith("| all | 1 | 1 | 100 |")


def test_an_interrupted_run_keeps_its_outcomes_only_for_the_same_sample() -> None:
    drawn = [{"package": "timing", "file": "a.py", "line": line, "outcome": ""} for line in (3, 5)]
    stored = [drawn[0] | {"outcome": "killed"}, drawn[1]]
    assert [one["outcome"] for one in stored_outcomes(drawn, stored)] == ["killed", ""]

    moved = [stored[0] | {"line": 4}, stored[1]]
    for other in (moved, stored[:1], stored[::-1]):
        with pytest.raises(SystemExit, match="another one, or the code changed"):
            stored_outcomes(drawn, other)
