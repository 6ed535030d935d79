"""A mutant is tested by the tests that execute its statement, fast tests first."""

from __future__ import annotations

import importlib
import importlib.util
import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

SOURCE = """LIMIT = 4
def limited(value):
    if (
        value > LIMIT
    ):
        return LIMIT
    return value
"""


@pytest.fixture
def executions() -> ModuleType:
    pytest.importorskip("coverage", reason="coverage is not installed: make mutation installs it")
    return importlib.import_module("tests.mutation.executions")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "sources" / "limited.py"
    path.parent.mkdir()
    path.write_text(SOURCE, encoding="utf-8")
    return path


def record(executions: ModuleType, source: Path, tests: dict[str, int], stored: Path) -> Any:
    """Call the function of the source once in each test, and return the recorder."""
    recorder = executions.ExecutionRecorder(source.parent)
    spec = importlib.util.spec_from_file_location("limited", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for test, value in tests.items():
        item = SimpleNamespace(nodeid=test, path=stored.parent / test.partition("::")[0])
        item.path.touch()
        hook = recorder.pytest_runtest_protocol(cast("pytest.Item", item))
        next(hook)
        module.limited(value)
        with pytest.raises(StopIteration):
            hook.send(None)
    return recorder


def test_only_tests_that_execute_a_statement_are_chosen(
    executions: ModuleType, source: Path, tmp_path: Path
) -> None:
    stored = tmp_path / "record.json"
    tests = {"test_a.py::test_low": 3, "test_a.py::test_high": 5, "test_b.py::test_high": 6}
    record(executions, source, tests, stored).store(stored)
    found = json.loads(stored.read_text(encoding="utf-8"))
    found["seconds"] = dict(zip(tests, [3.0, 2.0, 1.0], strict=True))

    # The condition is in the third line of the file; its operator is in the fourth.
    everything = ["test_b.py::test_high", "test_a.py::test_high", "test_a.py::test_low"]
    assert executions.tests_of(source, 4, found) == (everything, False)
    assert executions.tests_of(source, 6, found) == (everything[:2], False)
    assert executions.tests_of(source, 7, found) == (everything[2:], False)
    assert executions.tests_of(source, 1, found) == (everything, True)
    assert executions.tests_of(source, 99, found) == ([], False)


def test_tests_of_unchanged_files_are_taken_from_the_record(
    executions: ModuleType, source: Path, tmp_path: Path
) -> None:
    stored = tmp_path / "record.json"
    tests = {"test_a.py::test_low": 3, "test_b.py::test_removed": 5, "test_c.py::test_deleted": 6}
    record(executions, source, tests, stored).store(stored)
    again = record(executions, source, {"test_b.py::test_high": 5}, stored)
    again.store(stored, unchanged={"test_a.py"})
    found = json.loads(stored.read_text(encoding="utf-8"))
    assert set(found["seconds"]) == {"test_a.py::test_low", "test_b.py::test_high"}
    assert executions.tests_of(source, 6, found) == (["test_b.py::test_high"], False)
    assert executions.tests_of(source, 7, found) == (["test_a.py::test_low"], False)


def test_tests_with_a_cached_result_are_chosen_together(
    executions: ModuleType, source: Path, tmp_path: Path
) -> None:
    (tmp_path / "test_a.py").write_text("@cache\ndef fitted(): ...\n", encoding="utf-8")
    stored = tmp_path / "record.json"
    tests = {"test_a.py::test_low": 3, "test_a.py::test_high": 5}
    record(executions, source, tests, stored).store(stored)
    found = json.loads(stored.read_text(encoding="utf-8"))
    assert executions.tests_of(source, 6, found) == (["test_a.py"], False)
