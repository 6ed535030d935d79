"""Run the tests on all cores, then those that measure time alone: `make test`.

    .ci/suite.py [--experiments] [PYTEST ARGUMENTS]

With ``--experiments`` the tests with the marker ``experiment`` run, otherwise all others. Each part
leaves a JUnit report in ``build/tests`` or ``build/experiments``; the last line counts the tests of
both parts and the seconds.

System tests start daemons in real time, and tests with the marker `real_time` simulate devices that
send in real time. Other tests on the same cores can starve both. One that fails while others run is
repeated once, alone: it passes only if it passes then, and the summary names it. All other tests
get no second chance.

Invariant: the exit status is 0 only if both parts passed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path

BUILD = Path(__file__).resolve().parents[1] / "build"
WORKERS_PER_CORE = 3
"""Two thirds of the time of the tests is waiting, for devices and daemons in real time."""
EXPERIMENTS_PER_CORE = 2
"""Experiments compute, or run whole daemons with browsers: more of them starve each other."""
WORKERS = ("-p", "tests.forked_workers", "--workers")
"""Options of pytest that run the tests in workers; the number follows."""
ENVIRONMENT = {key: os.environ[key] for key in os.environ if key != "PYTHONDONTWRITEBYTECODE"}
"""Hundreds of processes import the project: none should have to compile it."""
TESTS_FAILED = 1
"""Exit status of pytest when tests failed."""
NO_TESTS = 5
"""Exit status of pytest when it collected nothing."""


def main(arguments: list[str]) -> int:
    """Run both parts; return the exit status."""
    began = time.monotonic()
    experiments = "--experiments" in arguments
    name, parts = (
        ("experiments", ("experiments", "experiments-alone"))
        if experiments
        else ("tests", ("parallel", "alone"))
    )
    arguments = [word for word in arguments if word != "--experiments"]
    reports = BUILD / name
    shutil.rmtree(reports, ignore_errors=True)
    cores = len(os.sched_getaffinity(0))
    workers = (EXPERIMENTS_PER_CORE if experiments else WORKERS_PER_CORE) * cores

    parallel = _run(parts[0], reports, [*WORKERS, str(workers), *arguments])
    disturbed: list[str] = []
    if parallel == TESTS_FAILED:
        disturbed = _repeat_tests_in_real_time(parts[0], reports)
        parallel = 0 if disturbed else parallel
    alone = _run(parts[1], reports, arguments or _files_of_tests_alone())

    duration_s = time.monotonic() - began
    for test in disturbed:
        print(f"failed beside others, passed alone: {test}")
    print(
        f"{name}: {_counts(reports, disturbed)} in {duration_s:.0f} s on {cores} cores", flush=True
    )
    failed = [status for status in (parallel, alone) if status not in {0, NO_TESTS}]
    if failed:
        return failed[0]
    return min(parallel, alone)  # nothing was collected only if neither part collected anything


def _run(part: str, reports: Path, arguments: list[str], report: str = "") -> int:
    path = reports / f"{report or part}.xml"
    command = [sys.executable, "-m", "pytest", "--part", part, f"--junitxml={path}", *arguments]
    return subprocess.run(command, check=False, env=ENVIRONMENT).returncode  # noqa: S603 - our own


def _files_of_tests_alone() -> list[str]:
    """Return the test files with the marker `alone`: to collect all others takes ten seconds."""
    files = sorted((BUILD.parent / "tests").rglob("test_*.py"))
    return [str(path) for path in files if "mark.alone" in path.read_text(encoding="utf-8")]


def _repeat_tests_in_real_time(part: str, reports: Path) -> list[str]:
    """Repeat failed tests in real time alone; return their names if this cleared all failures."""
    chosen = "system or real_time"
    selection = ["--last-failed", "--last-failed-no-failures=none", "-m", chosen]
    if _run(part, reports, selection, report="repeated") != 0:
        return []
    failed = {
        name
        for name, case in _cases(reports / f"{part}.xml")
        if {"failure", "error"} & {child.tag for child in case}
    }
    repeated = {name for name, _ in _cases(reports / "repeated.xml")}
    return sorted(failed) if failed <= repeated else []


def _cases(report: Path) -> list[tuple[str, ET.Element]]:
    """Return the tests of a report by name."""
    cases = ET.parse(report).getroot().iter("testcase")  # noqa: S314 - pytest's, just made
    return [(f"{case.get('classname')}::{case.get('name')}", case) for case in cases]


def _counts(reports: Path, disturbed: list[str]) -> str:
    suites = [
        suite
        for report in sorted(reports.glob("*.xml"))
        if report.stem != "repeated"
        for suite in ET.parse(report).getroot().iter("testsuite")  # noqa: S314 - pytest's, just made
    ]
    total, failed, errors, skipped = (
        sum(int(suite.get(key, 0)) for suite in suites)
        for key in ("tests", "failures", "errors", "skipped")
    )
    passed = total - failed - errors - skipped
    if disturbed:  # they have passed alone
        passed, failed, errors = passed + failed + errors, 0, 0
    return f"{passed} passed, {failed} failed, {errors} errors, {skipped} skipped"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
