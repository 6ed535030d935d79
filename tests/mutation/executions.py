"""Record of the tests that execute a line. Only these tests can detect a change of the line."""

from __future__ import annotations

import ast
import json
import re
import time
from typing import TYPE_CHECKING, Any

import coverage
import pytest

if TYPE_CHECKING:
    from collections.abc import Collection, Generator
    from pathlib import Path

IMPORT = ""
"""Context of lines that are executed while pytest imports the tests."""
SHARED_STATE = re.compile(r"^@cache\b|scope=", re.MULTILINE)
"""Pattern of test files with cached results or shared fixtures. In such a file, a test may depend
on lines that only an earlier test executed."""


class ExecutionRecorder:
    """Plugin of pytest that records the lines of a folder, and the processor time of each test.

    Tests of a file that share state are recorded together, under the name of the file.
    """

    def __init__(self, sources: Path) -> None:
        self._coverage = coverage.Coverage(
            data_file=None, config_file=False, source=[str(sources)], messages=False
        )
        self._seconds: dict[str, float] = {}
        self._coverage.start()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        file, _, _ = item.nodeid.partition("::")
        shares = SHARED_STATE.search(item.path.read_text(encoding="utf-8"))
        test = file if shares else item.nodeid
        self._coverage.switch_context(test)
        begin_s = time.process_time()
        try:
            return (yield)
        finally:
            used_s = time.process_time() - begin_s
            self._seconds[test] = self._seconds.get(test, 0.0) + used_s

    def store(self, path: Path, unchanged: Collection[str] = ()) -> None:
        """Write the tests of every line and the time of every test.

        Tests of the files `unchanged`, if any, are taken from the record at `path`.
        """
        self._coverage.stop()
        data = self._coverage.get_data()
        lines: dict[str, dict[str, list[str]]] = {
            file: {str(line): tests for line, tests in data.contexts_by_lineno(file).items()}
            for file in data.measured_files()
        }
        if unchanged:
            before = json.loads(path.read_text(encoding="utf-8"))
            for test, used_s in before["seconds"].items():
                if test.partition("::")[0] in unchanged:
                    self._seconds[test] = used_s
            for file, stored in before["lines"].items():
                for line, tests in stored.items():
                    known = [test for test in tests if test.partition("::")[0] in unchanged]
                    lines.setdefault(file, {}).setdefault(line, []).extend(known)
        path.write_text(json.dumps({"lines": lines, "seconds": self._seconds}), "utf-8")


def tests_of(path: Path, line: int, executions: dict[str, Any]) -> tuple[list[str], bool]:
    """Return the tests that execute a statement, fast ones first, and whether an import does so.

    If an import executes it, the tests that execute any line of its file are returned. Tests of one
    file stay together, because they may have fixtures in common.
    """
    lines = executions["lines"].get(str(path), {})
    found = {test for number in _statement(path, line) for test in lines.get(str(number), [])}
    at_import = IMPORT in found
    if at_import:
        found = {test for tests in lines.values() for test in tests}
    seconds: dict[str, float] = executions["seconds"]
    tests = sorted(found - {IMPORT}, key=lambda test: seconds[test])
    first: dict[str, int] = {}
    for order, test in enumerate(tests):
        first.setdefault(test.partition("::")[0], order)
    return sorted(tests, key=lambda test: first[test.partition("::")[0]]), at_import


def _statement(path: Path, line: int) -> range:
    """Return the lines of the innermost statement around a line, without its body."""
    innermost = range(line, line + 1)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or node.lineno) + 1
            if line < max(end, node.lineno + 1):
                innermost = range(node.lineno, max(end, node.lineno + 1))
    return innermost
