"""A short run of every fuzz target without coverage, and all inputs that failed once."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.inventory import REPRODUCERS, TARGETS, reproducers
from tests.fuzz.mutation import mutate
from tests.fuzz.target import LEAST_S, Target, UnaccountedError, run_case

if TYPE_CHECKING:
    from pathlib import Path

EXAMPLES = 15
MUTANTS = 40
PER_BYTE = [name for name in TARGETS if not name.endswith("-core")]
"""Targets whose cost depends on the bytes only. The cost of the core also depends on the time."""
SHORT = 15_000
"""Size of the shorter of two inputs, bytes. The longer input has four times this size."""
STEEPEST = 8.0
"""Largest ratio of the times of the two inputs. Linear time has the ratio 4, quadratic time 16."""
FAILED_ONCE = [path for name in TARGETS for path in reproducers(name)]


@pytest.mark.parametrize("name", TARGETS)
def test_valid_inputs_are_accepted_or_refused_as_documented(name: str) -> None:
    target = TARGETS[name]
    for seed in target.seeds():
        assert run_case(target, seed).finding == ""


@pytest.mark.parametrize("name", TARGETS)
def test_mutants_of_valid_inputs_keep_the_limits(name: str) -> None:
    target, dice = TARGETS[name], random.Random(name)
    seeds = target.seeds()
    longest = max(target.longest, *map(len, seeds))
    for _ in range(MUTANTS):
        data = mutate(seeds, dice, longest)
        assert run_case(target, data).finding == "", data


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.binary(max_size=300))
def test_any_bytes_keep_the_limits(name: str, data: bytes) -> None:
    assert run_case(TARGETS[name], data).finding == ""


@pytest.mark.parametrize("name", PER_BYTE)
def test_long_inputs_take_linear_time(name: str) -> None:
    target = TARGETS[name]
    seed = max(target.seeds(), key=len)
    short_s, long_s = (
        min(run_case(target, (seed * (size // len(seed) + 1))[:size]).seconds for _ in range(2))
        for size in (SHORT, 4 * SHORT)
    )
    assert long_s < max(LEAST_S, STEEPEST * short_s)


@pytest.mark.parametrize("path", FAILED_ONCE, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_an_input_that_failed_once_keeps_the_limits(path: Path) -> None:
    assert run_case(TARGETS[path.parent.name], path.read_bytes()).finding == ""


def test_every_reproducer_belongs_to_a_target() -> None:
    assert {folder.name for folder in REPRODUCERS.glob("*")} <= set(TARGETS)


# --- the limits themselves --------------------------------------------------------------------


def fault(data: bytes) -> None:
    if data.startswith(b"raise"):
        raise KeyError("x")
    if data.startswith(b"refuse"):
        raise ValueError("documented")
    if data.startswith(b"lose"):
        raise UnaccountedError("4 bytes, 3 in messages or discarded")
    if data.startswith(b"slow"):
        sum(range(30_000_000))
    if data.startswith(b"large"):  # 154 MB minus memory that this process released before
        bytes(range(256)) * 600_000


@pytest.mark.parametrize(
    ("data", "expected"),
    [(b"raise", "KeyError at"), (b"refuse", ""), (b"lose", "UnaccountedError at"),
     (b"slow", "slow: "), (b"large", "memory: grew by 1"), (b"", "")],
)  # fmt: skip
def test_a_fault_of_every_kind_is_found(data: bytes, expected: str) -> None:
    finding = run_case(Target("fault", fault, list, (ValueError,)), data).finding
    assert finding.startswith(expected)
    assert bool(finding) == bool(expected)
