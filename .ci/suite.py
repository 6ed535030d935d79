"""Run the tests on all cores, then the time measurements without other tests: `make test`.

    .ci/suite.py [--experiments] [PYTEST ARGUMENTS]

With ``--experiments``, the tests with the marker ``experiment`` run; otherwise, all other tests
run. Each part writes a JUnit report to ``build/tests`` or ``build/experiments``. The last line
contains the number of tests in both parts, and the time in seconds.

System tests start daemons in real time, and tests with the marker `real_time` simulate devices that
send in real time. Other tests on the same cores can delay both. If such a test fails while others
run, it is repeated once, alone. It passes only if it then passes, and the summary names it.
Experiments are repeated in the same way, because those that compute run at low priority and can
exceed a time limit; a wrong result is computed again. Other tests are not repeated.

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
"""Number of workers per core. For two thirds of their time, tests wait for devices and daemons in
real time."""
EXPERIMENTS_PER_CORE = 2
"""Number of workers per core for experiments, which compute, or run daemons and browsers. More
workers would delay each other."""
WORKERS = ("-p", "tests.forked_workers", "--workers")
"""Options of pytest that run the tests in workers. The number of workers follows."""
ENVIRONMENT = {key: os.environ[key] for key in os.environ if key != "PYTHONDONTWRITEBYTECODE"}
"""Environment of the tests. Hundreds of processes import the project, so it must be compiled only
once."""
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
        disturbed = _repeat_disturbed_tests(parts[0], reports, experiments)
        parallel = 0 if disturbed else parallel
    alone = _run(parts[1], reports, arguments or _files_of_tests_alone())

    duration_s = time.monotonic() - began
    for test in disturbed:
        print(f"failed next to others, passed alone: {test}")
    print(
        f"{name}: {_counts(reports, disturbed)} in {duration_s:.0f} s on {cores} cores", flush=True
    )
    failed = [status for status in (parallel, alone) if status not in {0, NO_TESTS}]
    if failed:
        return failed[0]
    return min(parallel, alone)  # NO_TESTS only if both parts collected nothing


def _run(part: str, reports: Path, arguments: list[str], report: str = "") -> int:
    path = reports / f"{report or part}.xml"
    command = [sys.executable, "-m", "pytest", "--part", part, f"--junitxml={path}", *arguments]
    return subprocess.run(command, check=False, env=ENVIRONMENT).returncode  # noqa: S603 - our own


def _files_of_tests_alone() -> list[str]:
    """Return the test files with the marker `alone`; collecting all files takes ten seconds."""
    files = sorted((BUILD.parent / "tests").rglob("test_*.py"))
    return [str(path) for path in files if "mark.alone" in path.read_text(encoding="utf-8")]


def _repeat_disturbed_tests(part: str, reports: Path, experiments: bool) -> list[str]:
    """Repeat failed tests that others can delay; return their names if this cleared all failures.

    The tests are selected by name: `--last-failed` does not select tests whose subtests failed.
    """
    failed = {
        name
        for name, case in _cases(reports / f"{part}.xml")
        if {"failure", "error"} & {child.tag for child in case}
    }
    selection = [*map(_node_id, sorted(failed))]
    if not experiments:
        selection += ["-m", "system or real_time"]
    if not failed or _run(part, reports, selection, report="repeated") != 0:
        return []
    repeated = {name for name, _ in _cases(reports / "repeated.xml")}
    return sorted(failed) if failed <= repeated else []


def _node_id(name: str) -> str:
    """Return the argument of pytest that selects a test by its name in a report."""
    place, _, test = name.partition("::")
    words = place.split(".")
    for count in range(len(words), 0, -1):
        path = Path(*words[:count]).with_suffix(".py")
        if (BUILD.parent / path).is_file():
            return "::".join([str(BUILD.parent / path), *words[count:], test])
    return name


def _cases(report: Path) -> list[tuple[str, ET.Element]]:
    """Return the tests in a report, each with its name."""
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
    if disturbed:  # these tests passed alone
        passed, failed, errors = passed + failed + errors, 0, 0
    return f"{passed} passed, {failed} failed, {errors} errors, {skipped} skipped"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
