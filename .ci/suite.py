"""Run the tests on all cores, then the time measurements without other tests: `make test`.

    .ci/suite.py [--experiments] [PYTEST ARGUMENTS]

With ``--experiments``, the tests with the marker ``experiment`` run; otherwise, all other tests
run. Each part writes a JUnit report to ``build/tests`` or ``build/experiments``. The last line
contains the number of tests in both parts, and the time in seconds.

System tests start daemons in real time, and tests with the marker `real_time` simulate devices that
send in real time. Other tests on the same cores can delay both. If such a test fails while others
run, it is repeated once, alone. It counts as passed only if the repetition passes, and the summary
names it.
Experiments are repeated in the same way, because those that compute run at low priority and can
exceed a time limit. An experiment with a wrong result fails in both runs. Tests with the marker
`alone` measure times, which a pause of the machine disturbs, so they are repeated, too. Other tests
are not repeated.

Invariant: the exit status is 0 only if both parts passed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

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
"""Environment of the tests. Python writes bytecode, because hundreds of processes import the
project."""
REPEATED = "-repeated"
"""End of the name of the report on repeated tests."""
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

    disturbed: dict[str, list[str]] = {}
    statuses = []
    for part, options in (
        (parts[0], [*WORKERS, str(workers), *arguments]),
        (parts[1], arguments or _files_of_tests_alone()),
    ):
        status = _run(part, reports, options)
        if status == TESTS_FAILED:
            every = experiments or part == parts[1]
            disturbed[part] = _repeat_disturbed_tests(part, reports, every)
            status = 0 if disturbed[part] else status
        statuses.append(status)

    duration_s = time.monotonic() - began
    for test in chain(*disturbed.values()):
        print(f"failed, then passed alone: {test}")
    print(
        f"{name}: {_counts(reports, disturbed)} in {duration_s:.0f} s on {cores} cores", flush=True
    )
    failed = [status for status in statuses if status not in {0, NO_TESTS}]
    if failed:
        return failed[0]
    return min(statuses)  # NO_TESTS only if both parts collected nothing


def _run(part: str, reports: Path, arguments: list[str], report: str = "") -> int:
    path = reports / f"{report or part}.xml"
    command = [sys.executable, "-m", "pytest", "--part", part, f"--junitxml={path}", *arguments]
    return subprocess.run(command, check=False, env=ENVIRONMENT).returncode  # noqa: S603 - our own


def _files_of_tests_alone() -> list[str]:
    """Return the test files whose text contains the marker `alone`.

    Selection of the marker by pytest would collect all files, which takes 10 seconds.
    """
    files = sorted((BUILD.parent / "tests").rglob("test_*.py"))
    return [str(path) for path in files if "mark.alone" in path.read_text(encoding="utf-8")]


def _repeat_disturbed_tests(part: str, reports: Path, every: bool) -> list[str]:
    """Repeat failed tests that others can delay; return the failed tests if all of them now pass.

    The tests are selected by name: `--last-failed` does not select tests whose subtests failed.

    Parameters
    ----------
    part
        Part of the suite, whose report names the failed tests.
    reports
        Folder of the reports.
    every
        Whether all tests of the part are repeated, not only system tests and tests in real time.
    """
    failed = {
        name
        for name, case in _cases(reports / f"{part}.xml")
        if {"failure", "error"} & {child.tag for child in case}
    }
    selection = [*map(_node_id, sorted(failed))]
    if not every:
        selection += ["-m", "system or real_time"]
    report = f"{part}{REPEATED}"
    if not failed or _run(part, reports, selection, report=report) != 0:
        return []
    repeated = {name for name, _ in _cases(reports / f"{report}.xml")}
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


def _counts(reports: Path, disturbed: Mapping[str, list[str]]) -> str:
    passed = failed = errors = skipped = 0
    for report in sorted(reports.glob("*.xml")):
        if report.stem.endswith(REPEATED):
            continue
        for suite in ET.parse(report).getroot().iter("testsuite"):  # noqa: S314 - pytest's, just made
            total, failures, faults, left_out = (
                int(suite.get(key, 0)) for key in ("tests", "failures", "errors", "skipped")
            )
            if disturbed.get(report.stem):  # the failed tests of this report passed alone
                failures = faults = 0
            passed += total - failures - faults - left_out
            failed, errors, skipped = failed + failures, errors + faults, skipped + left_out
    return f"{passed} passed, {failed} failed, {errors} errors, {skipped} skipped"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
