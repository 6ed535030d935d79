"""Run the tests on all cores, then those that measure time alone: `make test`.

    .ci/suite.py [--experiments] [PYTEST ARGUMENTS]

With ``--experiments`` the tests with the marker ``experiment`` run, otherwise all others. Each part
leaves a JUnit report in ``build/tests`` or ``build/experiments``; the last line counts the tests of
both parts and the seconds.

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
WORKERS_PER_CORE = 2
"""Half of the time of the long tests is waiting, for devices and daemons in real time."""
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
    workers = cores if experiments else WORKERS_PER_CORE * cores  # experiments compute

    # An idle worker takes tests from the others: there are few long ones.
    parallel = _run(parts[0], reports, ["-n", str(workers), "--dist", "worksteal", *arguments])
    alone = _run(parts[1], reports, arguments)

    duration_s = time.monotonic() - began
    print(f"{name}: {_counts(reports)} in {duration_s:.0f} s on {cores} cores", flush=True)
    failed = [status for status in (parallel, alone) if status not in {0, NO_TESTS}]
    if failed:
        return failed[0]
    return min(parallel, alone)  # nothing was collected only if neither part collected anything


def _run(part: str, reports: Path, arguments: list[str]) -> int:
    report = reports / f"{part}.xml"
    command = [sys.executable, "-m", "pytest", "--part", part, f"--junitxml={report}", *arguments]
    return subprocess.run(command, check=False).returncode  # noqa: S603 - our own command


def _counts(reports: Path) -> str:
    suites = [
        suite
        for report in sorted(reports.glob("*.xml"))
        for suite in ET.parse(report).getroot().iter("testsuite")  # noqa: S314 - pytest's, just made
    ]
    total, failed, errors, skipped = (
        sum(int(suite.get(key, 0)) for suite in suites)
        for key in ("tests", "failures", "errors", "skipped")
    )
    passed = total - failed - errors - skipped
    return f"{passed} passed, {failed} failed, {errors} errors, {skipped} skipped"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
