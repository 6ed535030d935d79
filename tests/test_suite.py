"""Selection and time limits of tests in the runs of `make test` and `make test-experiments`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.conftest import EXPERIMENT_TIMEOUT_S

if TYPE_CHECKING:
    from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def suite(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / ".ci"))
    module = __import__("suite")
    sys.modules.pop("suite")
    return module


class TestNames:
    @pytest.mark.parametrize("word", ["plain", "a b.c::d"])
    def test_the_name_in_a_report_selects_the_same_test(
        self, word: str, request: pytest.FixtureRequest, suite: ModuleType
    ) -> None:
        name = f"tests.test_suite.TestNames::{request.node.name}"
        assert word in name
        assert suite._node_id(name) == f"{ROOT}/{request.node.nodeid}"


REPORT = """<testsuites><testsuite>
<testcase classname="tests.test_suite" name="test_one"><failure/></testcase>
<testcase classname="tests.test_suite" name="test_two"/>
</testsuite></testsuites>"""


@pytest.mark.parametrize("every", [True, False])
@pytest.mark.parametrize("status", [0, 1])
def test_a_failed_test_counts_as_passed_only_if_it_passes_alone(
    tmp_path: Path,
    suite: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    every: bool,
    status: int,
) -> None:
    (tmp_path / "part.xml").write_text(REPORT, encoding="utf-8")
    calls: list[list[str]] = []

    def run(_part: str, reports: Path, arguments: list[str], report: str) -> int:
        calls.append(arguments)
        (reports / f"{report}.xml").write_text(REPORT, encoding="utf-8")
        return status

    monkeypatch.setattr(suite, "_run", run)
    cleared = suite._repeat_disturbed_tests("part", tmp_path, every)
    assert cleared == ([] if status else ["tests.test_suite::test_one"])
    only_real_time = [] if every else ["-m", "system or real_time"]
    assert calls == [[f"{ROOT}/tests/test_suite.py::test_one", *only_real_time]]


@pytest.mark.parametrize("repeated", [0, 1])
def test_a_measurement_that_fails_is_repeated_once_and_named(
    tmp_path: Path,
    suite: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    repeated: int,
) -> None:
    """A pause of the machine can disturb a time measurement, even if the test runs alone."""
    calls: list[str] = []

    def run(part: str, reports: Path, arguments: list[str], report: str = "") -> int:
        calls.append(report or part)
        assert "system or real_time" not in arguments  # every measurement is repeated
        failed = part == "alone"
        text = REPORT if failed else REPORT.replace("<failure/>", "")
        counts = f'<testsuite tests="2" failures="{int(failed)}" errors="0" skipped="0">'
        reports.mkdir(exist_ok=True)
        (reports / f"{report or part}.xml").write_text(
            text.replace("<testsuite>", counts), encoding="utf-8"
        )
        return repeated if report else int(failed)

    monkeypatch.setattr(suite, "BUILD", tmp_path / "build")
    (tmp_path / "build").mkdir()
    monkeypatch.setattr(suite, "_run", run)
    assert suite.main([]) == repeated
    assert calls == ["parallel", "alone", "alone-repeated"]
    printed = capsys.readouterr().out
    assert ("failed, then passed alone: tests.test_suite::test_one" in printed) == (not repeated)
    assert f"{4 - repeated} passed, {repeated} failed" in printed


@pytest.mark.experiment
def test_an_experiment_without_a_limit_of_its_own_has_that_of_experiments(
    request: pytest.FixtureRequest,
) -> None:
    marker = request.node.get_closest_marker("timeout")
    assert marker is not None
    assert marker.args == (EXPERIMENT_TIMEOUT_S,)
