"""Processor time per byte over the inputs of a target: the median, and findings."""

from __future__ import annotations

import pytest

from tests.fuzz.byte_costs import LEAST_BYTES, SETTLED, ByteCosts
from tests.fuzz.target import Target

EVEN = bytes(LEAST_BYTES)
STEEP = b"steep" + EVEN


def cost(data: bytes) -> None:
    sum(range(2_000_000 if data.startswith(b"steep") else 100))


@pytest.fixture
def costs() -> ByteCosts:
    found = ByteCosts(Target("cost", cost, list))
    for _ in range(SETTLED):
        assert found.add(EVEN, 1e-6 * LEAST_BYTES) == ""
    return found


def test_the_median_is_that_of_long_inputs(costs: ByteCosts) -> None:
    assert costs.add(b"short", 1.0) == ""
    assert costs.median_s == pytest.approx(1e-6, rel=0.05)


def test_an_input_of_expensive_bytes_is_a_finding(costs: ByteCosts) -> None:
    assert costs.add(STEEP, 1.0).startswith("uneven: ")
    assert costs.ratio is not None
    assert costs.ratio > 3.0


def test_a_pause_of_the_machine_is_no_finding(costs: ByteCosts) -> None:
    assert costs.add(EVEN, 1.0) == ""


def test_few_inputs_have_no_ratio() -> None:
    found = ByteCosts(Target("cost", cost, list))
    assert found.add(STEEP, 1.0) == ""
    assert found.ratio is None
