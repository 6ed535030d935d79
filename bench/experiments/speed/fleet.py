"""Load of a fleet of fifty simulated gateways with one mosquitto broker."""

from __future__ import annotations

import asyncio
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.measurement import percentile, speed_experiment, timed_result
from bench.rigs.fleet import ALL, FORWARDED, measure_fleet, record_traffic
from tests.broker_fixture import MosquittoBroker

if TYPE_CHECKING:
    from bench.framework.experiment import Result

GATEWAYS = 50
RECORDED_S, MEASURED_S = 12.0, 20.0


async def _measure(folder: Path, broker: MosquittoBroker, quick: bool) -> list[Result]:
    recorded_s, measured_s = (3.0, 3.0) if quick else (RECORDED_S, MEASURED_S)
    selections = {"forwarded": FORWARDED, "everything": ALL}
    traffic = await record_traffic(folder, broker.port, recorded_s, selections)

    results: list[Result] = []
    for name, words in (("forwarded", "forwarded topics"), ("everything", "all topics")):
        one = traffic[name]
        found = await measure_fleet(broker, one, GATEWAYS, measured_s)
        p50, p99 = (percentile(found.latencies_ms, share) for share in (0.5, 0.99))
        forwarded = name == "forwarded"
        results += [
            timed_result(
                f"{words}: messages of one gateway", round(one.messages_s, 1), "messages/s",
                note=f"{one.retained} retained",
            ),
            timed_result(f"{words}: bytes of one gateway", round(one.bytes_s / 1e3, 1), "kB/s"),
            timed_result(
                f"{words}: messages at the station", round(found.messages_s), "messages/s",
                note=f"{GATEWAYS} gateways",
            ),
            timed_result(
                f"{words}: lost", found.lost, "messages", 0, 0 if forwarded else None,
            ),
            timed_result(
                f"{words}: broker's CPU", round(found.broker_pct, 1), "% of a core",
                20 if forwarded else None, 60 if forwarded else None,
            ),
            timed_result(f"{words}: broker's memory", round(found.broker_mb, 1), "MB", 50, 100),
            timed_result(f"{words}: latency of pose/ui, median", round(p50, 2), "ms"),
            timed_result(
                f"{words}: latency of pose/ui, p99", round(p99, 2), "ms",
                20 if forwarded else None, 400 if forwarded else None,
                note=f"{len(found.latencies_ms)} poses",
            ),
            timed_result(
                f"{words}: all online after a restart of the broker", round(found.back_s, 2), "s",
                2, 10,
            ),
        ]  # fmt: skip
    return results


def fleet_results(quick: bool) -> list[Result]:
    """Record one daemon's messages, then send them from fifty gateways."""
    if (reason := MosquittoBroker.missing()) is not None:
        print(f"not run: {reason}", file=sys.stderr)
        return []
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        # A central computer that receives bursts of all gateways needs a queue of more than 1000
        # messages.
        broker = MosquittoBroker(Path(temporary), more="max_queued_messages 10000\n")
        broker.start()
        try:
            return asyncio.run(_measure(Path(temporary), broker, quick))
        finally:
            broker.stop()


EXPERIMENTS = (
    speed_experiment(
        "fleet-of-fifty-gateways",
        "Fifty simulated gateways at one mosquitto",
        fleet_results,
    ),
)
