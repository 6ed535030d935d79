"""Mutants are those that a test can notice, and the score has its interval."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

import pytest

from tests.mutation.score import interval, table_of

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
    changes = {mutant.change() for mutant in found}
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


def test_equivalent_mutants_do_not_count() -> None:
    outcomes = ["killed", "killed", "survived", "equivalent"]
    results = {"mutants": [{"package": "timing", "outcome": outcome} for outcome in outcomes]}
    row = table_of(results).splitlines()[-1]
    assert row.startswith("| all | 4 | 2 | 1 | 1 | 67 |")
