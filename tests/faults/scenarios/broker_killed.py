"""The broker is killed and started again without its retained messages."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Kill the broker for a second."""
    before = (await gateway.health())["devices"]["S1"]
    gateway.broker.stop()
    noticed_s = await gateway.disconnected()
    await asyncio.sleep(1.0)
    gateway.broker.start()
    recovered_s = await gateway.used("S1", "S2")
    after = (await gateway.health())["devices"]["S1"]
    lost = sum(after[key] - before[key] for key in ("lost", "late", "dropped"))
    return Outcome(noticed_s, recovered_s, 0.0, lost)


SCENARIO = Scenario(
    title="broker killed for a second",
    reported="log; `connects` of the link in `bridge/health`",
    continues="acquisition, fusion and recording",
    counted="poses (a gap in `seq`); the figure is `lost` + `late` + `dropped` of one sensor",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=1.0,
)
