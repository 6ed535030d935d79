"""The table on docs/reliability.md that compares the daemon with other programs."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).with_name("peers.json")
DAEMON = "jointfitd"
FREQUENT = "aiomqtt, pause of 0.2 s"
SAMPLE_S = 0.01
"""Period of the sensors, s."""
FLOOD_S = 10.0
"""Time for which the serial line of gpsd is filled, s."""


def table_of(results: dict[str, Any]) -> str:
    """Return the table of the page."""
    rows = [
        "| fault | program | runs | median, s | maximum, s |",
        "| --- | --- | --: | --: | --: |",
    ]
    for fault, programs in results["times_s"].items():
        rows += [
            f"| {fault} | {name} | {len(values)} | {statistics.median(values):.2f} "
            f"| {max(values):.2f} |"
            for name, values in sorted(programs.items(), key=lambda item: item[0] != DAEMON)
        ]
    text = "\n".join(rows)
    if counts := results["gpsd_flood"]:
        text += (
            f"\n\nWhen a line of 921 600 baud was filled with position sentences for {FLOOD_S:g} s,"
            f" gpsd reported {counts['received']} of {counts['sent']} sentences."
        )
    return text


def slower_than_a_peer(results: dict[str, Any]) -> list[str]:
    """Return the faults after which a peer recovers sooner than the daemon, in the median.

    The publisher with the shorter pause does not count: it shows the time that frequent attempts
    would save. A difference of less than one sample does not count either.
    """
    found = []
    for fault, programs in results["times_s"].items():
        median_s = {name: statistics.median(values) for name, values in programs.items()}
        daemon_s = median_s.pop(DAEMON)
        median_s.pop(FREQUENT, None)
        if daemon_s > min(median_s.values()) + SAMPLE_S:
            found.append(fault)
    return found
