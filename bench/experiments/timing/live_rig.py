"""Errors of arrival stamps under load, and of all stamps of a rig whose devices restart."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.experiment import Experiment, Result
from bench.framework.material import LIVE_RIG
from bench.rigs.loopback import delays_ns
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from bench.rigs.device_restarts import RestartRun

_DATAGRAMS = 3000
_REBOOTS = ("S1", "mocap", "S2", "S3", "mocap", "S4")


def _arrivals(_: Path) -> list[Result]:
    stamped, read = (sorted(delays) for delays in delays_ns(_DATAGRAMS))
    at_99 = int(0.99 * _DATAGRAMS)
    free = float("inf")
    return [
        Result("kernel timestamp, median", stamped[_DATAGRAMS // 2] / NS_PER_MS, free, unit="ms"),
        Result("kernel timestamp, 99 %", stamped[at_99] / NS_PER_MS, 0.1, unit="ms"),
        Result("timestamp in Python, 99 %", read[at_99] / NS_PER_MS, free, -free, unit="ms"),
    ]


async def _live() -> RestartRun:
    from bench.rigs.device_restarts import live  # noqa: PLC0415 - needs further packages
    from tests.broker_fixture import chosen_broker  # noqa: PLC0415 - needs further packages

    with tempfile.TemporaryDirectory() as folder:
        broker = chosen_broker()(Path(folder))
        broker.start()
        try:
            return await live(Path(folder), broker.port, _REBOOTS, rest_s=4.0)
        finally:
            broker.stop()


def _restarts(_: Path) -> list[Result]:
    found = asyncio.run(_live())
    frames = found.frame_errors_ns
    late = sum(error > 0.5 * NS_PER_MS for error in frames)
    figures = [
        Result(
            "largest error of a frame flagged synchronized",
            max(frames) / NS_PER_MS,
            0.5,
            unit="ms",
        ),
        Result("frames flagged synchronized with a larger error", float(late), 0.0, unit=""),
        Result("frames evaluated", float(len(frames)), float("inf"), minimum=1000, unit=""),
        Result(
            "share of samples missing in the log of the simulator", found.unknown, 0.01, unit=""
        ),
        Result("replay byte-identical", float(found.replayed), 1.0, minimum=1.0, unit=""),
    ]
    for source in ("S1", "S2", "S3", "S4", "mocap"):
        worst = max(map(abs, found.errors_ns(source))) / NS_PER_MS
        figures.append(
            Result(
                f"{source}: largest error of a sample flagged synchronized", worst, 0.5, unit="ms"
            )
        )
    return figures


EXPERIMENTS = (
    Experiment(
        "arrival-timestamps",
        "Arrival timestamps with the event loop blocked for 4 ms at a time",
        _arrivals,
        LIVE_RIG,
        timed=True,
    ),
    Experiment(
        "live-rig-restarts",
        "Errors of stamps in a live rig, with clock errors of up to 50 ppm and six device restarts",
        _restarts,
        LIVE_RIG,
        packages=("orjson",),
        long=True,
    ),
)
