"""Run experiments: ``python -m bench [ID ...]``.

Without IDs, the short set of experiments runs, at most 10 minutes on two cores. The option
``--full`` runs all experiments. Results are stored in ``bench/results``, and the pages of docs are
generated again. The exit code is 1 if a result misses its threshold and is not listed in
`Experiment.known_misses`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework import pages, storage
from bench.framework.experiment import DATA, Experiment, Result, find_experiments
from bench.framework.measurement import machine
from bench.framework.table import text_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ROOT = Path(__file__).resolve().parents[1]
SINGLE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""Environment variables for speed experiments. The daemon's systemd units set the same value."""

Measured = list[tuple[Experiment, list[Result]]]


def main(words: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(words)
    known = {experiment.id: experiment for experiment in find_experiments()}
    if unknown := [name for name in options.ids if name not in known]:
        print(f"no experiment {', '.join(unknown)}; --list prints the IDs", file=sys.stderr)
        return 2
    chosen = [known[name] for name in options.ids] or [*known.values()]
    if options.topic:
        chosen = [experiment for experiment in chosen if experiment.topic == options.topic]
    if options.list:
        for experiment in chosen:
            print(f"{experiment.id:42} {experiment.topic:14} {experiment.title}")
        return 0

    quick = options.quick or not (options.ids or options.full or options.topic)
    if quick:
        chosen = [e for e in chosen if storage.in_short_run(e) or e.quick_run is not None]
    measured = _measure(chosen, options, quick=quick)
    if options.json:
        _write_json(options.json, measured)
    if options.single_thread:
        return 0
    print(text_table(measured))
    if not options.dry_run:
        _write_pages(measured, quick=quick)
    return _exit_code(measured)


def _measure(chosen: Sequence[Experiment], options: argparse.Namespace, *, quick: bool) -> Measured:
    """Run experiments, and store each result at once; results of shortened runs are not stored."""
    measured: Measured = []
    for experiment, results in run_all(chosen, quick=quick, single_thread=options.single_thread):
        measured.append((experiment, results))
        shortened = quick and experiment.quick_run is not None
        if results and not shortened and not options.dry_run:
            storage.store(experiment.id, storage.to_json(experiment, results))
    return measured


def _exit_code(measured: Measured) -> int:
    missed = [
        f"{experiment.id}: {result.name}"
        for experiment, results in measured
        for result in experiment.unexpected(results)
    ]
    if missed:
        print("\n".join(["thresholds missed:", *missed]), file=sys.stderr)
    return 1 if missed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("ids", nargs="*", metavar="ID", help="experiments to run at full length")
    parser.add_argument("--full", action="store_true", help="all experiments, about an hour")
    parser.add_argument("--topic", metavar="NAME", help="the experiments of one topic")
    parser.add_argument("--quick", action="store_true", help="run the short forms where they exist")
    parser.add_argument("--list", action="store_true", help="print IDs, topics and titles")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to FILE")
    parser.add_argument("--dry-run", action="store_true", help="run, but store no results or pages")
    parser.add_argument("--single-thread", action="store_true", help=argparse.SUPPRESS)
    return parser


def run_all(
    chosen: Sequence[Experiment], *, quick: bool, single_thread: bool = False
) -> Iterator[tuple[Experiment, list[Result]]]:
    """Run experiments in order; speed experiments run last, in one process with one BLAS thread."""
    fast = [] if single_thread else [e for e in chosen if e.topic == "speed"]
    for experiment in chosen:
        if experiment not in fast:
            yield experiment, run_one(experiment, quick=quick)
    if fast:
        yield from _in_child(fast, quick=quick)


def run_one(experiment: Experiment, *, quick: bool) -> list[Result]:
    """Return the results of one experiment; no results if recordings or packages are missing."""
    if (reason := experiment.missing()) is not None:
        print(f"{experiment.id} skipped: {reason}", file=sys.stderr)
        return []
    run = experiment.run
    if quick and experiment.quick_run is not None:
        run = experiment.quick_run
    began = time.perf_counter()
    results = run(DATA)
    seconds = time.perf_counter() - began
    print(f"{experiment.id}: {seconds:.1f} s", file=sys.stderr, flush=True)
    return results


def _in_child(chosen: Sequence[Experiment], *, quick: bool) -> Measured:
    known = {experiment.id: experiment for experiment in chosen}
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as folder:
        written = Path(folder) / "speed.json"
        options = ["--single-thread", "--dry-run", "--json", str(written)]
        words = [sys.executable, "-m", "bench", *known, *options]
        subprocess.run(  # noqa: S603 - this program
            [*words, "--quick"] if quick else words,
            cwd=ROOT,
            env=os.environ | SINGLE_THREAD,
            check=True,
        )
        contents = json.loads(written.read_text(encoding="utf-8"))
    return [(known[content["experiment"]], storage.results_of(content)) for content in contents]


def _write_json(path: Path, measured: Measured) -> None:
    contents = [storage.to_json(experiment, results) for experiment, results in measured]
    path.write_text(json.dumps(contents, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _write_pages(measured: Measured, *, quick: bool) -> None:
    """Generate the pages; if times were measured, store a description of the machine first."""
    if not quick and any(experiment.topic == "speed" for experiment, _ in measured):
        storage.store(storage.MACHINE, machine())
    for path in pages.write():
        print(f"written: {path.relative_to(ROOT)}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
