"""Coverage-guided fuzzing of every entrance: ``make fuzz``.

Each target runs in a process of its own under atheris (libFuzzer). A finding is stored under
build/fuzz/TARGET/ and fuzzing goes on. The exit code is 1 if there was a finding.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.fuzz.target import Target

CASES = 10_000_000
OUT = Path("build/fuzz")
PACKAGES = ["jointfit_daemon", "jointfit_drivers", "jointfit_protocols"]
MOST_FINDINGS = 20
"""A target with so many different findings stops."""
NOT_INSTALLED = 3
_DAY_S = 86_400.0
_EXTRA_S = 60
"""Processor start, imports and seeds of one target, s."""


# --- one target, in its own process -----------------------------------------------------------


@dataclass
class Tally:
    """What the cases of one target did so far."""

    target: Target
    folders: tuple[Path, ...]
    """Removed at the end."""
    cases: int = 0
    began: float = field(default_factory=time.monotonic)
    growth: int = 0
    slowest_s: float = 0.0
    findings: dict[str, str] = field(default_factory=dict)

    def case(self, data: bytes) -> None:
        """Run one case and keep count."""
        from tests.fuzz.target import run_case

        outcome = run_case(self.target, data)
        self.cases += 1
        self.growth = max(self.growth, outcome.growth)
        self.slowest_s = max(self.slowest_s, outcome.seconds)
        first_line = outcome.finding.partition("\n")[0]
        if first_line and first_line.split(":")[0] not in self.findings:
            self._store(data, outcome.finding)

    def _store(self, data: bytes, finding: str) -> None:
        folder = OUT / self.target.name
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / hashlib.sha256(data).hexdigest()[:16]
        path.write_bytes(data)
        path.with_suffix(".txt").write_text(finding, encoding="utf-8", errors="replace")
        first_line = finding.partition("\n")[0]
        self.findings[first_line.split(":")[0]] = f"{path}: {first_line}"
        if len(self.findings) >= MOST_FINDINGS:
            self.end()

    def end(self) -> None:
        """Report and end the process: libFuzzer runs no exit handlers of Python."""
        self.report()
        for folder in self.folders:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)

    def report(self) -> None:
        """Write the result where the parent process reads it."""
        result = {
            "cases": self.cases,
            "seconds": round(time.monotonic() - self.began, 1),
            "findings": list(self.findings.values()),
            "growth_mb": round(self.growth / 1e6, 2),
            "slowest_ms": round(1e3 * self.slowest_s, 1),
        }
        OUT.mkdir(parents=True, exist_ok=True)
        (OUT / f"{self.target.name}.json").write_text(json.dumps(result), encoding="utf-8")


def fuzz_one(name: str, cases: int, seconds: float) -> None:
    """Fuzz one target in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=PACKAGES, enable_loader_override=False):
        from tests.fuzz.broker_targets import folder
        from tests.fuzz.inventory import TARGETS, reproducers

    target = TARGETS[name]
    corpus = Path(tempfile.mkdtemp(prefix=f"fuzz-{name}-"))
    seeds = [*target.seeds(), *(path.read_bytes() for path in reproducers(name))]
    for number, seed in enumerate(seeds):
        (corpus / f"seed{number}").write_bytes(seed)

    # What is loaded once is not charged to a case.
    for seed in seeds:
        with contextlib.suppress(Exception):
            target.run(seed)
    tally = Tally(target, (corpus, folder()))
    until = tally.began + seconds

    def case(data: bytes) -> None:
        tally.case(data)
        if tally.cases >= cases or time.monotonic() > until:
            tally.end()

    longest = max(target.longest, *map(len, seeds))
    options = [sys.argv[0], "-runs=-1", f"-max_len={longest}", "-verbosity=0"]
    options += ["-timeout=60", "-rss_limit_mb=0", f"-artifact_prefix={OUT}/{name}-", str(corpus)]
    atheris.Setup(options, case)
    atheris.Fuzz()


# --- all targets ------------------------------------------------------------------------------


def shares(names: Sequence[str], whole: float) -> dict[str, float]:
    """Divide a number among targets by their share."""
    from tests.fuzz.inventory import TARGETS

    total = sum(TARGETS[name].share for name in names)
    return {name: whole * TARGETS[name].share / total for name in names}


def run_target(name: str, cases: int, seconds: float) -> dict[str, Any]:
    """Fuzz one target in a process of its own and return its result."""
    result = OUT / f"{name}.json"
    result.unlink(missing_ok=True)
    command = [sys.executable, "-m", "tests.fuzz", "--child", name]
    command += ["--cases", str(cases), "--seconds", str(seconds)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with (OUT / f"{name}.log").open("wb") as log:
        done = subprocess.run(
            command, env=environment, stdout=log, stderr=log, check=False,
            timeout=seconds + 10 * _EXTRA_S,
        )  # fmt: skip
    if result.exists():
        found: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
        return found
    text = f"ended with exit code {done.returncode}: see {OUT / name}.log"
    return {"cases": 0, "seconds": 0, "findings": [text], "growth_mb": 0, "slowest_ms": 0}


def row(name: str, result: dict[str, Any]) -> str:
    """Return one line of the table."""
    cells = (result["cases"], result["seconds"], len(result["findings"]))
    return (
        f"| {name:19} | "
        + " | ".join(f"{cell:>9}" for cell in (*cells, result["growth_mb"], result["slowest_ms"]))
        + " |"
    )


def fuzz_all(names: Sequence[str], cases: int, seconds: float, jobs: int) -> int:
    """Fuzz every target, print the table and return the exit code."""
    OUT.mkdir(parents=True, exist_ok=True)
    by_cases = shares(names, cases)
    print("| target              |     cases |   seconds |  findings | growth MB |   slow ms |")
    print("|---|--:|--:|--:|--:|--:|")
    most_s = jobs * seconds / len(names) if seconds else _DAY_S

    def run(name: str) -> dict[str, Any]:
        result = run_target(name, max(1, round(by_cases[name])), most_s)
        print(row(name, result), flush=True)
        return result

    with ThreadPoolExecutor(jobs) as pool:
        results = dict(zip(names, pool.map(run, names), strict=True))

    total = sum(result["cases"] for result in results.values())
    findings = [line for result in results.values() for line in result["findings"]]
    print(f"{total} cases, {len(findings)} findings")
    for line in findings:
        print(f"  {line}")
    (OUT / "result.json").write_text(
        json.dumps({"cases": total, "targets": results}, indent=1) + "\n", encoding="utf-8"
    )
    return 1 if findings else 0


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="make fuzz ARGS=", description=__doc__)
    parser.add_argument("targets", nargs="*", help="names of targets; default: all")
    parser.add_argument("--cases", type=int, default=CASES, help="in all (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=0, help="at most, in all; 0: no limit")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="targets at a time")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        fuzz_one(given.child, given.cases, given.seconds)
    try:
        import atheris  # noqa: F401 - in the dependency group `fuzz` only
    except ImportError:
        print("atheris is not installed: pip install --group fuzz (x86-64 Linux only)")
        return NOT_INSTALLED

    from tests.fuzz.inventory import TARGETS

    unknown = set(given.targets) - set(TARGETS)
    if unknown:
        parser.error(f"no such target: {', '.join(sorted(unknown))}; known: {', '.join(TARGETS)}")
    return fuzz_all(given.targets or list(TARGETS), given.cases, given.seconds, given.jobs)


if __name__ == "__main__":
    sys.exit(main())
