"""Rows T4 and T9: arrival stamps under load, and every stamp of a live rig through restarts."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.experiment import Experiment, Figure
from bench.rigs.loopback import delays_ns

if TYPE_CHECKING:
    from bench.rigs.device_restarts import Outcome

_NS_PER_MS = 1e6
_DATAGRAMS = 3000
_REBOOTS = ("S1", "mocap", "S2", "S3", "mocap", "S4")


def _arrivals(_: Path) -> list[Figure]:
    stamped, read = (sorted(delays) for delays in delays_ns(_DATAGRAMS))
    at_99 = int(0.99 * _DATAGRAMS)
    free = float("inf")
    return [
        Figure("kernel stamp, median", stamped[_DATAGRAMS // 2] / _NS_PER_MS, free, unit="ms"),
        Figure("kernel stamp, 99 %", stamped[at_99] / _NS_PER_MS, 0.1, unit="ms"),
        Figure("stamp in Python instead, 99 %", read[at_99] / _NS_PER_MS, free, -free, unit="ms"),
    ]


async def _live() -> Outcome:
    from bench.rigs.device_restarts import live  # noqa: PLC0415 - a rig needs packages other rows do without
    from tests.broker_fixture import chosen_broker  # noqa: PLC0415 - so do brokers

    with tempfile.TemporaryDirectory() as folder:
        broker = chosen_broker()(Path(folder))
        broker.start()
        try:
            return await live(Path(folder), broker.port, _REBOOTS, rest_s=4.0)
        finally:
            broker.stop()


def _restarts(_: Path) -> list[Figure]:
    found = asyncio.run(_live())
    frames = found.frame_errors_ns
    late = sum(error > 0.5 * _NS_PER_MS for error in frames)
    figures = [
        Figure("worst synced frame", max(frames) / _NS_PER_MS, 0.5, unit="ms"),
        Figure("frames that say synced and are not", float(late), 0.0, unit=""),
        Figure("frames judged", float(len(frames)), float("inf"), least=1000, unit=""),
        Figure("samples the truth does not know", found.unknown, 0.01, unit=""),
        Figure("replayed byte for byte", float(found.replayed), 1.0, least=1.0, unit=""),
    ]
    for source in ("S1", "S2", "S3", "S4", "mocap"):
        worst = max(map(abs, found.errors_ns(source))) / _NS_PER_MS
        figures.append(Figure(f"{source}: worst synced stamp", worst, 0.5, unit="ms"))
    return figures


EXPERIMENTS = (
    Experiment("T4", "arrival stamps, loop blocked 4 ms at a time", _arrivals, timed=True),
    Experiment("T9", "live rig, ±50 ppm, six reboots", _restarts,
               packages=("orjson",), long=True),
)  # fmt: skip
