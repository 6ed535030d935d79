"""The table of ``make load`` on docs/reliability.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results.json"
COUNTERS = ("lost", "corrupt", "dropped", "late")
SMALLEST_SHARE = 0.98
"""Smallest accepted ratio of the number of sent samples to the product of rate and duration. With a
smaller ratio, the load was too low."""


def table_of(results: dict[str, Any]) -> str:
    """Return the counts of all inputs as a table."""
    rows = [
        f"| input | rate, Hz | sent | received | {' | '.join(COUNTERS)} |",
        "| --- | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for name, found in results["inputs"].items():
        counts = " | ".join(str(found[key]) for key in COUNTERS)
        rows.append(
            f"| {name} | {found['rate_hz']} | {found['sent']} | {found['received']} | {counts} |"
        )
    return "\n".join(rows)


def faults_of(results: dict[str, Any]) -> list[str]:
    """Return the inputs with a sample that was not received, was lost, corrupt or dropped.

    Inputs with a sample without an outcome, and inputs that sent less than `SMALLEST_SHARE` of
    their samples, are also returned.
    """
    return [
        f"{name}: {found}"
        for name, found in results["inputs"].items()
        if found["sent"] < SMALLEST_SHARE * found["rate_hz"] * results["seconds"]
        or found["sent"] != found["received"]
        or found["unaccounted"]
        or any(found[key] for key in ("lost", "corrupt", "dropped"))
    ]
