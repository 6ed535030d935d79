"""Selection and time limits of tests in the runs of `make test` and `make test-experiments`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.conftest import EXPERIMENT_TIMEOUT_S

ROOT = Path(__file__).resolve().parents[1]


class TestNames:
    @pytest.mark.parametrize("word", ["plain", "a b.c::d"])
    def test_the_name_in_a_report_selects_the_same_test(
        self, word: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.syspath_prepend(str(ROOT / ".ci"))
        suite = __import__("suite")
        sys.modules.pop("suite")
        name = f"tests.test_suite.TestNames::{request.node.name}"
        assert word in name
        assert suite._node_id(name) == f"{ROOT}/{request.node.nodeid}"


@pytest.mark.experiment
def test_an_experiment_without_a_limit_of_its_own_has_that_of_experiments(
    request: pytest.FixtureRequest,
) -> None:
    marker = request.node.get_closest_marker("timeout")
    assert marker is not None
    assert marker.args == (EXPERIMENT_TIMEOUT_S,)
