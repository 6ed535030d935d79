"""``make faults``: run fault scenarios; with several runs of each, write docs/reliability.md."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.broker_fixture import chosen_broker
from tests.faults.peers import compare_with_peers
from tests.faults.run import PAGE, RESULTS, render, run_all, scenarios, stored, summary

if TYPE_CHECKING:
    from tests.faults.scenario import Outcome


def main() -> int:
    """Run the scenarios; return 1 if a scenario failed or exceeded a limit."""
    known = scenarios()
    parser = argparse.ArgumentParser(prog="make faults", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    parser.add_argument("--repeat", type=int, default=1, help="runs of each scenario")
    parser.add_argument(
        "--peers", action="store_true", help="compare the daemon with gpsd and aiomqtt instead"
    )
    options = parser.parse_args()
    if options.peers:
        return compare_with_peers(options.repeat, store=options.repeat > 1)
    if unknown := set(options.names) - known.keys():
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(known)}")

    outcomes: dict[str, list[Outcome]] = {}
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        broker = chosen_broker()(Path(name))
        broker.start()
        try:
            names = options.names or list(known)
            run = run_all(Path(name), broker, names, options.repeat, outcomes)
            failures = asyncio.run(run)
        finally:
            broker.stop()
            if options.repeat > 1:
                store({key: summary(found) for key, found in outcomes.items()})

    faults = failures + [
        text for key, found in outcomes.items() for one in found for text in known[key].faults(one)
    ]
    for key, found in outcomes.items():
        median_s, limit_s = summary(found)["recovered_median_s"], known[key].recovered_median_s
        if limit_s is not None and median_s > limit_s:
            text = f"median time to recovery {median_s:.2f} s, limit {limit_s:g} s"
            faults.append(f"{key}: {text}")
    print("\n".join(faults) or "all limits are met")
    return 1 if faults else 0


def store(figures: dict[str, Any]) -> None:
    """Store the figures of scenarios, and write docs/reliability.md."""
    results = stored() if RESULTS.exists() else {"scenarios": {}}
    results["scenarios"] |= figures
    cores, python, load = os.cpu_count(), platform.python_version(), os.getloadavg()[0]
    results["machine"] = f"{cores} cores, Python {python}, load {load:.1f}"
    RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", "utf-8")
    PAGE.write_text(render(results), "utf-8")


sys.exit(main())
