"""Run the tests on all cores, then those that measure time alone: `make test`.

    .ci/suite.py [PYTEST ARGUMENTS]

Invariant: the exit status is 0 only if both parts passed. Each part leaves a JUnit report in
``build/tests``; the last line counts the tests of both and the seconds.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path

REPORTS = Path(__file__).resolve().parents[1] / "build" / "tests"
NO_TESTS = 5
"""Exit status of pytest when it collected nothing."""


def main(arguments: list[str]) -> int:
    """Run both parts; return the exit status."""
    began = time.monotonic()
    shutil.rmtree(REPORTS, ignore_errors=True)
    cores = len(os.sched_getaffinity(0))
    # A worker that is idle takes tests from others: the long system tests are a few.
    parallel = _run("parallel", ["-n", str(cores), "--dist", "worksteal", *arguments])
    alone = _run("alone", arguments)

    print(f"{_counts()} in {time.monotonic() - began:.0f} s on {cores} cores", flush=True)
    failed = [status for status in (parallel, alone) if status not in {0, NO_TESTS}]
    if failed:
        return failed[0]
    return min(parallel, alone)  # nothing was collected only if neither part collected anything


def _run(part: str, arguments: list[str]) -> int:
    report = REPORTS / f"{part}.xml"
    command = [sys.executable, "-m", "pytest", "--part", part, f"--junitxml={report}", *arguments]
    return subprocess.run(command, check=False).returncode  # noqa: S603 - our own command


def _counts() -> str:
    suites = [
        suite
        for report in sorted(REPORTS.glob("*.xml"))
        for suite in ET.parse(report).getroot().iter("testsuite")  # noqa: S314 - pytest's, just made
    ]
    total, failed, errors, skipped = (
        sum(int(suite.get(key, 0)) for suite in suites)
        for key in ("tests", "failures", "errors", "skipped")
    )
    passed = total - failed - errors - skipped
    return f"make test: {passed} passed, {failed} failed, {errors} errors, {skipped} skipped"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
