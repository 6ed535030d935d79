"""``make mutation``: measures the share of random mutants that the tests of a package detect.

A mutant is the code with one small change, such as another operator.
"""

from __future__ import annotations

import argparse
import importlib.machinery
import json
import multiprocessing
import os
import random
import resource
import signal
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy  # noqa: F401 - as above
import pytest
import scipy.optimize  # noqa: F401 - as above
from hypothesis import HealthCheck, settings

from tests.mutation.executions import ExecutionRecorder, tests_of
from tests.mutation.mutants import Mutant, mutants_of
from tests.mutation.score import RESULTS, stored_outcomes, table_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import CodeType

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "calibration record": ("jointfit_daemon/calibration/record", "tests/calibration/record"),
    "protocols": ("protocols/jointfit_protocols", "tests/protocols"),
    "timing": ("jointfit_daemon/timing", "tests/timing"),
    "fusion": ("jointfit_daemon/fusion", "tests/fusion"),
}
"""Sources and tests of each package."""
FAST = "not system and not experiment and not alone and not real_time and not vm"
OPTIONS = ["-x", "-q", "-m", FAST, "-p", "no:cacheprovider", "-o", "timeout=0"]
OPTIONS += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
"""Options of pytest. Tests that start processes are excluded, because a process would import the
unchanged source.
"""
CPU_FACTOR, CPU_S = 15, 5
"""Limit of the processor time of the tests of a mutant: `CPU_FACTOR` times the time without mutant,
plus `CPU_S` seconds. The time without a mutant is measured with a tenth of the inputs of property
tests.

The tests of a mutant that need more time are stopped, and the mutant counts as detected, because it
probably contains an endless loop.
"""
WALL_S = 7200.0
"""Time limit for tests that wait without end, s."""
Chosen = tuple[Mutant, dict[str, Any]]
"""A mutant, and its description in the results."""
PASSED = 0
SURVIVED = "survived"


def main() -> int:
    """Test a sample of mutants, or the stored survivors again, and print each outcome."""
    parser = argparse.ArgumentParser(prog="make mutation", description=__doc__)
    parser.add_argument("--mutants", type=int, default=200, help="size of the sample")
    parser.add_argument("--seed", type=int, default=20, help="random seed (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="mutants tested at the same time")
    parser.add_argument("--store", action="store_true", help="store the outcomes")
    parser.add_argument(
        "--review", action="store_true", help="only test the stored survivors again, and store"
    )
    parser.add_argument(
        "--resume", action="store_true", help="keep the stored outcomes of an interrupted run"
    )
    options = parser.parse_args()

    os.chdir(ROOT)
    os.nice(15)
    _import_libraries()
    stored = json.loads(RESULTS.read_text(encoding="utf-8"))
    if options.review:
        chosen = [(_find(one), one) for one in stored["mutants"] if one["outcome"] == SURVIVED]
    else:
        chosen = sample(options.mutants, options.seed)
        mutants = [one for _, one in chosen]
        if options.resume:
            mutants = stored_outcomes(mutants, stored["mutants"])
            chosen = [(each, one) for (each, _), one in zip(chosen, mutants, strict=True)]
        stored = {"seed": options.seed, "drawn": len(mutants), "mutants": mutants}

    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("fork")) as pool:
        packages = [name for name in PACKAGES if not options.review or name in _survived_in(stored)]
        records = {package: pool.submit(record_executions, package) for package in packages[:2]}
        for at, package in enumerate(packages):
            records[package].result()
            part = [
                (mutant, one)
                for mutant, one in chosen
                if one["package"] == package and (options.review or not one["outcome"])
            ]
            tested = pool.map(judge, [package] * len(part), [mutant for mutant, _ in part])
            for later in packages[at + 2 : at + 3]:
                records[later] = pool.submit(record_executions, later)
            for (_, one), (is_killed, before, after) in zip(part, tested, strict=True):
                killed = "killed later" if options.review else "killed"
                one.update(before=before, after=after, outcome=killed if is_killed else SURVIVED)
                print("{outcome:12} {file}:{line}: {before}  ->  {after}".format(**one), flush=True)
            if options.store or options.review:
                RESULTS.write_text(json.dumps(stored, indent=1) + "\n", "utf-8")

    print(table_of(stored["mutants"]))
    outcomes = Counter(one["outcome"] for one in stored["mutants"])
    return 1 if outcomes[SURVIVED] > 0.1 * outcomes.total() else 0


def _survived_in(stored: dict[str, Any]) -> set[str]:
    return {one["package"] for one in stored["mutants"] if one["outcome"] == SURVIVED}


def _import_libraries() -> None:
    """Import the libraries of the tests once; each fork imports the project itself anew."""
    import tests.conftest  # noqa: F401 - it imports them

    for name in list(sys.modules):
        if name.startswith(("jointfit_", "tests.")) and not name.startswith("tests.mutation"):
            del sys.modules[name]

    # Health checks measure time, and would fail on a loaded machine. A few inputs show which lines
    # a test executes.
    suite, checks = settings.get_profile("suite"), list(HealthCheck)
    settings.register_profile("mutant", suite, suppress_health_check=checks)
    settings.register_profile("record", suite, suppress_health_check=checks, max_examples=5)


def sample(size: int, seed: int) -> list[Chosen]:
    """Return `size` mutants drawn at random from all mutants of all packages."""
    everything = [
        (package, mutant)
        for package, (sources, _) in PACKAGES.items()
        for path in sorted((ROOT / sources).rglob("*.py"))
        for mutant in mutants_of(path)
    ]
    print(f"{len(everything)} mutants, of which {size} are drawn", flush=True)
    chosen: list[Chosen] = []
    for package, mutant in random.Random(seed).sample(everything, size):
        name = mutant.path.relative_to(ROOT).as_posix()
        one = {"package": package, "file": name, "line": mutant.line, "before": "", "after": ""}
        chosen.append((mutant, one | {"outcome": "", "reason": ""}))
    return chosen


def _find(one: dict[str, Any]) -> Mutant:
    """Return the mutant of a stored description; its line may have moved."""
    path = ROOT / one["file"]
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    change = (one["before"], one["after"])
    # The first line that differs may be the line before, if a line break is lost.
    possible = [
        each for each in mutants_of(path) if change[0] in lines[max(each.line - 2, 0) : each.line]
    ]
    possible.sort(key=lambda each: abs(each.line - one["line"]))
    found = next((each for each in possible if each.change(each.source()) == change), None)
    if found is None:
        sys.exit(f"{one['file']}:{one['line']}: this code changed; set its outcome to `removed`")
    return found


def record_executions(package: str) -> None:
    """Run the tests of a package without mutant, and store which lines each executes.

    Stored tests are run again only if their file or a source of the package is newer than the
    record.
    """
    sources, tests = PACKAGES[package]
    record = _record(package)
    record.parent.mkdir(parents=True, exist_ok=True)
    done_s = record.stat().st_mtime if record.exists() else 0.0
    if any(file.stat().st_mtime > done_s for file in (ROOT / sources).rglob("*.py")):
        record.unlink(missing_ok=True)
        done_s = 0.0
    files = [str(file.relative_to(ROOT)) for file in sorted((ROOT / tests).rglob("test_*.py"))]
    changed = [file for file in files if (ROOT / file).stat().st_mtime > done_s]
    if not changed:
        return

    def run() -> int:
        os.environ["HYPOTHESIS_PROFILE"] = "record"
        recorder = ExecutionRecorder(ROOT / sources)
        status = int(pytest.main([*OPTIONS, *changed], [recorder]))
        recorder.store(record, unchanged=set(files) - set(changed))
        return status

    if in_fork(run, record.with_suffix(".log")) != PASSED:
        record.unlink(missing_ok=True)
        sys.exit(
            f"{tests}: tests fail without a mutant; their output is in {record.with_suffix('.log')}"
        )


def _record(package: str) -> Path:
    return ROOT / "build" / "mutation" / f"{package}.json"


@cache
def _executions(package: str) -> dict[str, Any]:
    executions: dict[str, Any] = json.loads(_record(package).read_text(encoding="utf-8"))
    return executions


def judge(package: str, mutant: Mutant) -> tuple[bool, str, str]:
    """Return whether a test detects the mutant, and the changed line before and after.

    The tests that execute the changed statement are run. If an import executes the statement, the
    tests that execute any line of its file, and all tests of the nearest folder are run.
    """
    executions = _executions(package)
    tests, at_import = tests_of(mutant.path, mutant.line, executions)
    if at_import:
        tests.append(nearest_folder(mutant.path, package))
    seconds = executions["seconds"].values() if at_import else map(executions["seconds"].get, tests)
    limit_s = CPU_S + round(CPU_FACTOR * sum(seconds))
    source = mutant.source()

    def run() -> int:
        os.environ["HYPOTHESIS_PROFILE"] = "mutant"
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        _replace(mutant.path, source)
        return int(pytest.main([*OPTIONS, *tests]))

    return bool(tests) and in_fork(run) != PASSED, *mutant.change(source)


def nearest_folder(path: Path, package: str) -> str:
    """Return the test folder that corresponds to the nearest folder of a module."""
    sources, tests = (ROOT / folder for folder in PACKAGES[package])
    nearest = path.parent
    while not (tests / nearest.relative_to(sources)).is_dir():
        nearest = nearest.parent
    return (tests / nearest.relative_to(sources)).relative_to(ROOT).as_posix()


def in_fork(run: Callable[[], int], log: Path = Path(os.devnull)) -> int:
    """Call a function in a fork; return its result, or the exit status if the fork dies."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setpgid(0, 0)
            output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            os.dup2(output, 1)
            os.dup2(output, 2)
            status = run()
        finally:
            os._exit(status)
    return _wait(child)


def _wait(child: int) -> int:
    """Wait for the tests, or kill them after `WALL_S`; return their exit code."""
    end_s, status = time.monotonic() + WALL_S, 0
    while time.monotonic() < end_s:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        time.sleep(0.02)
    else:
        os.killpg(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def _replace(path: Path, source: str) -> None:
    """Make the import of a file execute `source` instead of the content of the file."""
    original = importlib.machinery.SourceFileLoader.get_code

    def get_code(self: importlib.machinery.SourceFileLoader, fullname: str) -> CodeType | None:
        if Path(self.path).resolve() == path:
            return compile(source, str(path), "exec", dont_inherit=True)
        return original(self, fullname)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]  # of its own loader only


sys.exit(main())
