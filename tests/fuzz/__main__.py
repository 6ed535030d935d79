"""Coverage-guided fuzzing of every input of the program: ``make fuzz``.

Each target runs in two processes, one after the other. The first process is guided by coverage
(atheris, libFuzzer). It stores the inputs that reach new code in build/fuzz/corpus/TARGET, and the
next run begins with these inputs. The second process changes these inputs at random without
coverage, which is about five times faster. A finding is an input that causes an undocumented
exception, or exceeds a limit of time or memory. It is stored under build/fuzz/TARGET/, and fuzzing
continues. The exit code is 1 if there was a finding.

The instrumentation of the modules takes ten seconds, longer than a short run of a target. Each job
therefore has one process that imports all modules, and the guided processes are its forks.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import hashlib
import json
import math
import os
import queue
import random
import shutil
import subprocess
import sys
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.fuzz.byte_costs import ByteCosts
    from tests.fuzz.target import Target

CASES = 10_000_000
OUT = Path("build/fuzz")
PACKAGES = ["jointfit_daemon", "jointfit_drivers", "jointfit_protocols"]
MOST_FINDINGS = 20
"""Number of different findings after which a target stops."""
NOT_INSTALLED = 3
GUIDED, MUTATED = "guided", "mutated"
GUIDED_PART = 0.2
"""Share of the cases of a target that coverage guides. They may take half of the time."""
ENVIRONMENT = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
_DAY_S = 86_400.0
_EXTRA_S = 60
"""Additional time for start, imports and seeds of one target, s."""


# --- one target, in its own process -----------------------------------------------------------


@dataclass
class Tally:
    """Results of the cases of one target so far."""

    target: Target
    folder: Path
    """Working folder, which is removed at the end."""
    most_cases: int
    until: float
    """Monotonic time of the end, s."""
    cases: int = 0
    began: float = field(default_factory=time.monotonic)
    growth: int = 0
    slowest_s: float = 0.0
    findings: dict[str, str] = field(default_factory=dict)
    costs: ByteCosts = field(init=False)

    def __post_init__(self) -> None:
        from tests.fuzz.byte_costs import ByteCosts

        self.costs = ByteCosts(self.target)

    def case(self, data: bytes) -> None:
        """Run and count one case; end the process after the last case."""
        from tests.fuzz.inventory import DECODERS
        from tests.fuzz.target import run_case

        outcome = run_case(self.target, data)
        uneven = self.costs.add(data, outcome.seconds)
        if self.target.name in DECODERS:
            self._report_finding(data, uneven)
        self.cases += 1
        self.growth = max(self.growth, outcome.growth)
        self.slowest_s = max(self.slowest_s, outcome.seconds)
        self._report_finding(data, outcome.finding)
        if self.cases >= self.most_cases or time.monotonic() > self.until:
            self.end()

    def _report_finding(self, data: bytes, finding: str) -> None:
        """Store an input whose finding is new."""
        first_line = finding.partition("\n")[0]
        if not first_line or first_line.split(":")[0] in self.findings:
            return
        folder = OUT / self.target.name
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / hashlib.sha256(data).hexdigest()[:16]
        path.write_bytes(data)
        path.with_suffix(".txt").write_text(finding, encoding="utf-8", errors="replace")
        self.findings[first_line.split(":")[0]] = f"{path}: {first_line}"
        if len(self.findings) >= MOST_FINDINGS:
            self.end()

    def end(self) -> None:
        """Report, and end the process, because libFuzzer runs no exit handlers of Python."""
        self.report()
        shutil.rmtree(self.folder, ignore_errors=True)
        os._exit(0)

    def report(self) -> None:
        """Write the result to the file that the parent process reads."""
        result = {
            "cases": self.cases,
            "seconds": round(time.monotonic() - self.began, 1),
            "findings": list(self.findings.values()),
            "growth_mb": round(self.growth / 1e6, 2),
            "slowest_ms": round(1e3 * self.slowest_s, 1),
            "worst_byte": None if self.costs.ratio is None else round(self.costs.ratio, 1),
        }
        OUT.mkdir(parents=True, exist_ok=True)
        (OUT / f"{self.target.name}.json").write_text(json.dumps(result), encoding="utf-8")


def serve_guided() -> None:
    """Import all modules with instrumentation, then fuzz one target per input line in a fork.

    A line contains name, cases and seconds. The answer is a line with the exit code.
    """
    import atheris

    with atheris.instrument_imports(include=PACKAGES, enable_loader_override=False):
        from tests.fuzz import inventory  # noqa: F401 - imports all targets
    gc.freeze()  # the forks share these objects without copies

    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    for line in sys.stdin:
        name, cases, seconds = line.split()
        fork = os.fork()
        if fork == 0:
            log = os.open(OUT / f"{name}-{GUIDED}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, sys.stdout.fileno())
            os.dup2(log, sys.stderr.fileno())
            try:
                fuzz_one(name, GUIDED, int(cases), float(seconds))
            finally:  # after an error, a fork must not read the next line
                traceback.print_exc()
                os._exit(1)
        _, status = os.waitpid(fork, 0)
        print(os.waitstatus_to_exitcode(status), file=answers, flush=True)


def fuzz_one(name: str, mode: str, cases: int, seconds: float) -> None:
    """Fuzz one target in this process; the function does not return."""
    from tests.fuzz.broker_targets import folder
    from tests.fuzz.inventory import TARGETS, reproducers

    target, corpus = TARGETS[name], OUT / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    seeds = [*target.seeds(), *(path.read_bytes() for path in reproducers(name))]
    for number, seed in enumerate(seeds):
        (corpus / f"seed{number}").write_bytes(seed)

    # Run each seed once, so that the import of modules does not count as a cost of a case.
    for seed in seeds:
        with contextlib.suppress(Exception):
            target.run(seed)
    longest = max(target.longest, *map(len, seeds))
    tally = Tally(target, folder(), cases, time.monotonic() + seconds)
    if mode == GUIDED:
        _follow_coverage(tally, corpus, longest)
    _mutate_corpus(tally, corpus, longest)


def _follow_coverage(tally: Tally, corpus: Path, longest: int) -> None:
    import atheris

    options = [sys.argv[0], "-runs=-1", f"-max_len={longest}", "-verbosity=0"]
    options += ["-timeout=60", "-rss_limit_mb=0"]
    options += [f"-artifact_prefix={OUT}/{tally.target.name}-", str(corpus)]
    atheris.Setup(options, tally.case)
    atheris.Fuzz()


def _mutate_corpus(tally: Tally, corpus: Path, longest: int) -> None:
    from tests.fuzz.mutation import mutate

    inputs = [path.read_bytes() for path in sorted(corpus.iterdir())]
    seed = time.time_ns()
    print(f"seed {seed}", flush=True)
    dice = random.Random(seed)
    while True:
        tally.case(mutate(inputs, dice, longest))


# --- all targets ------------------------------------------------------------------------------


def shares(names: Sequence[str], whole: float) -> dict[str, float]:
    """Return the part of the number `whole` for each target, according to its share."""
    from tests.fuzz.inventory import TARGETS

    total = sum(TARGETS[name].share for name in names)
    return {name: whole * TARGETS[name].share / total for name in names}


def run_target(
    name: str, cases: int, seconds: float, guided_server: subprocess.Popen[str]
) -> dict[str, Any]:
    """Fuzz one target with and without coverage; return the result of both parts."""
    result = OUT / f"{name}.json"
    result.unlink(missing_ok=True)
    exit_code = _run_guided(name, math.ceil(GUIDED_PART * cases), seconds / 2, guided_server)
    guided = _read_result(name, GUIDED, exit_code)
    if guided["cases"] >= cases:
        return guided | {"guided": guided["cases"]}

    result.unlink(missing_ok=True)
    exit_code = _run_mutated(name, cases - guided["cases"], seconds - guided["seconds"])
    mutated = _read_result(name, MUTATED, exit_code)
    return {
        "cases": guided["cases"] + mutated["cases"],
        "guided": guided["cases"],
        "seconds": round(guided["seconds"] + mutated["seconds"], 1),
        "findings": guided["findings"] + mutated["findings"],
        "growth_mb": max(guided["growth_mb"], mutated["growth_mb"]),
        "slowest_ms": max(guided["slowest_ms"], mutated["slowest_ms"]),
        "worst_byte": max(
            (part["worst_byte"] for part in (guided, mutated) if part["worst_byte"]), default=None
        ),
    }


def start_guided_server() -> subprocess.Popen[str]:
    """Start and return the process of `serve_guided`."""
    with (OUT / f"{GUIDED}.log").open("ab") as log:  # a list of all instrumented modules
        return subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz", "--serve-guided"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=ENVIRONMENT,
        )  # fmt: skip


def _run_guided(name: str, cases: int, seconds: float, server: subprocess.Popen[str]) -> int:
    if server.stdin is None or server.stdout is None:
        raise RuntimeError("the server of guided runs has no pipes")
    server.stdin.write(f"{name} {cases} {seconds}\n")
    server.stdin.flush()
    return int(server.stdout.readline() or -1)


def _run_mutated(name: str, cases: int, seconds: float) -> int:
    command = [sys.executable, "-m", "tests.fuzz", "--mutate", name]
    command += ["--cases", str(cases), "--seconds", str(seconds)]
    with (OUT / f"{name}-{MUTATED}.log").open("wb") as log:
        return subprocess.run(
            command, env=ENVIRONMENT, stdout=log, stderr=log, check=False,
            timeout=seconds + 10 * _EXTRA_S,
        ).returncode  # fmt: skip


def _read_result(name: str, mode: str, exit_code: int) -> dict[str, Any]:
    result = OUT / f"{name}.json"
    if result.exists():
        found: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
        return found
    text = f"ended with exit code {exit_code}: see {OUT}/{name}-{mode}.log"
    nothing = {"cases": 0, "seconds": 0, "growth_mb": 0, "slowest_ms": 0, "worst_byte": None}
    return nothing | {"findings": [text]}


def row(name: str, result: dict[str, Any]) -> str:
    """Return one line of the table."""
    cells = (
        result["cases"], result["guided"], result["seconds"], len(result["findings"]),
        result["growth_mb"], result["slowest_ms"], result["worst_byte"] or "-",
    )  # fmt: skip
    return f"| {name:19} | " + " | ".join(f"{cell:>9}" for cell in cells) + " |"


def fuzz_all(names: Sequence[str], cases: int, seconds: float, jobs: int) -> int:
    """Fuzz every target, print the table and return the exit code."""
    OUT.mkdir(parents=True, exist_ok=True)
    by_cases = shares(names, cases)
    heads = ("cases", "guided", "seconds", "findings", "growth MB", "slow ms", "byte x")
    print(f"| {'target':19} | " + " | ".join(f"{head:>9}" for head in heads) + " |")
    print("|---|" + "--:|" * len(heads))
    most_s = jobs * seconds / len(names) if seconds else _DAY_S

    servers: queue.SimpleQueue[subprocess.Popen[str]] = queue.SimpleQueue()
    for _ in range(jobs):
        servers.put(start_guided_server())

    def run(name: str) -> dict[str, Any]:
        server = servers.get()
        result = run_target(name, max(1, round(by_cases[name])), most_s, server)
        servers.put(server)
        print(row(name, result), flush=True)
        return result

    with ThreadPoolExecutor(jobs) as pool:
        results = dict(zip(names, pool.map(run, names), strict=True))
    for _ in range(jobs):
        servers.get().communicate()

    total, guided = (sum(result[key] for result in results.values()) for key in ("cases", "guided"))
    findings = [line for result in results.values() for line in result["findings"]]
    print(f"{total} cases, {guided} of them guided by coverage, {len(findings)} findings")
    for line in findings:
        print(f"  {line}")
    (OUT / "result.json").write_text(
        json.dumps({"cases": total, "guided": guided, "targets": results}, indent=1) + "\n",
        encoding="utf-8",
    )
    return 1 if findings else 0


def main() -> int:
    """Fuzz the targets on the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="make fuzz ARGS=", description=__doc__)
    parser.add_argument("targets", nargs="*", help="names of targets; default: all")
    parser.add_argument("--cases", type=int, default=CASES, help="of all targets (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0, help="limit for all targets; 0: none")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="targets at a time")
    parser.add_argument("--serve-guided", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--mutate", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve_guided:
        serve_guided()
        return 0
    if given.mutate:
        fuzz_one(given.targets[0], MUTATED, given.cases, given.seconds)
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
