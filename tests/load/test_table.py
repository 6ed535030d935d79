"""A sample that is missing or without an outcome is a fault."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.load.table import RESULTS, faults_of

RIGHT = {
    "rate_hz": 10, "sent": 10, "received": 10, "lost": 0, "corrupt": 0, "dropped": 0, "late": 1,
    "unaccounted": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        {"received": 9},
        {"dropped": 1},
        {"lost": 1},
        {"corrupt": 1},
        {"unaccounted": -1},
        {"sent": 9, "received": 9},
    ],
)
def test_each_kind_of_loss_is_a_fault(change: dict[str, Any]) -> None:
    assert faults_of({"seconds": 1.0, "inputs": {"S1": RIGHT}}) == []
    assert len(faults_of({"seconds": 1.0, "inputs": {"S1": RIGHT | change}})) == 1


def test_the_stored_run_lost_nothing() -> None:
    assert faults_of(json.loads(RESULTS.read_text("utf-8"))) == []
