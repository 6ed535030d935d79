"""``make mutation``: how many of a random sample of mutants the tests of their package notice."""

from __future__ import annotations

import argparse
import importlib.machinery
import json
import os
import random
import resource
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy  # noqa: F401 - as above
import pytest
import scipy.optimize  # noqa: F401 - as above

from tests.mutation.mutants import Mutant, mutants_of
from tests.mutation.score import RESULTS, table_of

if TYPE_CHECKING:
    from types import CodeType

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "protocols": ("protocols/jointfit_protocols", "tests/protocols"),
    "timing": ("jointfit_daemon/timing", "tests/timing"),
    "fusion": ("jointfit_daemon/fusion", "tests/fusion"),
    "calibration record": ("jointfit_daemon/calibration/record", "tests/calibration/record"),
}
"""Sources and tests of each package."""
FAST = "not system and not experiment and not alone and not real_time and not vm"
"""Tests that start processes would import the unchanged source."""
SEED = 20
CPU_S = 120
"""Processor time of the tests of a mutant; a mutant that needs more is killed: it loops."""
WALL_S = 1200.0
PASSED = 0


def main() -> int:
    """Test a sample of mutants and print those that survived."""
    parser = argparse.ArgumentParser(prog="make mutation", description=__doc__)
    parser.add_argument("--mutants", type=int, default=200, help="size of the sample")
    parser.add_argument(
        "--seed", type=int, default=SEED, help="of the sample (default: %(default)s)"
    )
    parser.add_argument("--minutes", type=float, default=600.0, help="stop after this time")
    parser.add_argument("--store", action="store_true", help="for docs/reliability.md")
    options = parser.parse_args()

    os.chdir(ROOT)
    os.nice(15)
    known = _reviewed()
    end_s = time.monotonic() + 60 * options.minutes
    found: list[dict[str, Any]] = []
    results = {"seed": options.seed, "mutants": found}
    unchanged: set[tuple[str, ...]] = set()
    for package, mutant in sample(options.mutants, options.seed):
        tests = tests_of(mutant.path, package)
        if tests not in unchanged and run_tests(tests) != PASSED:
            sys.exit(f"{' '.join(tests)}: these tests fail without a mutant: repair them first")
        unchanged.add(tests)

        before, after = mutant.change()
        name = mutant.path.relative_to(ROOT).as_posix()
        outcome = "killed" if run_tests(tests, mutant) != PASSED else "survived"
        if outcome == "survived" and (name, before, after) in known:
            outcome = "equivalent"
        found.append(
            {
                "package": package, "file": name, "line": mutant.line, "before": before,
                "after": after, "outcome": outcome,
                "reason": known.get((name, before, after), ""),
            }
        )  # fmt: skip
        print(
            f"{len(found):4} {outcome:10} {name}:{mutant.line}: {before}  ->  {after}", flush=True
        )
        if options.store:
            RESULTS.write_text(json.dumps(results, indent=1) + "\n", "utf-8")
        if time.monotonic() > end_s:
            break
    print(table_of(results))
    survived = Counter(one["outcome"] for one in found)["survived"]
    return 1 if survived > 0.1 * len(found) else 0


def _reviewed() -> dict[tuple[str, str, str], str]:
    """Return the equivalent mutants of the stored run, with the reason."""
    if not RESULTS.exists():
        return {}
    return {
        (one["file"], one["before"], one["after"]): one["reason"]
        for one in json.loads(RESULTS.read_text(encoding="utf-8"))["mutants"]
        if one["reason"]
    }


def sample(size: int, seed: int) -> list[tuple[str, Mutant]]:
    """Return mutants drawn at random, as many of each package as it has mutants."""
    everything = [
        (package, mutant)
        for package, (sources, _) in PACKAGES.items()
        for path in sorted((ROOT / sources).rglob("*.py"))
        for mutant in mutants_of(path)
    ]
    print(f"{len(everything)} mutants, of which {size} are drawn", flush=True)
    return random.Random(seed).sample(everything, size)


def tests_of(path: Path, package: str) -> tuple[str, ...]:
    """Return the tests of a module: the nearest folder with the name of one of its folders."""
    sources, tests = (ROOT / folder for folder in PACKAGES[package])
    nearest = path.parent
    while not (tests / nearest.relative_to(sources)).is_dir():
        nearest = nearest.parent
    return ((tests / nearest.relative_to(sources)).relative_to(ROOT).as_posix(),)


def run_tests(tests: tuple[str, ...], mutant: Mutant | None = None) -> int:
    """Run tests in a fork until the first fails; return its exit status, 0 if all passed."""
    source = mutant.source() if mutant else ""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setpgid(0, 0)
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
            silence = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)
            os.dup2(silence, 2)
            if mutant:
                _replace(mutant.path, source)
            words = ["-x", "-q", "-m", FAST, "-p", "no:cacheprovider", "-o", "timeout=0"]
            status = int(pytest.main([*words, *tests]))
        finally:
            os._exit(status)
    return _wait(child)


def _wait(child: int) -> int:
    """Wait for the tests, and kill them with their processes when their time is over."""
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
    """Let the import of a file use another source."""
    original = importlib.machinery.SourceFileLoader.get_code

    def get_code(self: importlib.machinery.SourceFileLoader, fullname: str) -> CodeType | None:
        if Path(self.path).resolve() == path:
            return compile(source, str(path), "exec", dont_inherit=True)
        return original(self, fullname)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]  # of its own loader only


sys.exit(main())
