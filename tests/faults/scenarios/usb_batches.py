"""USB adapters deliver two successive samples of a sensor together, every 20 ms."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Send successive samples of each sensor in pairs for two seconds."""
    since = len(gateway.listener.poses)
    before = (await gateway.health())["devices"]["S1"]
    for sensor in gateway.sensors.values():
        sensor.batch = 2
    await asyncio.sleep(2.0)
    for sensor in gateway.sensors.values():
        sensor.batch = 1
    after = (await gateway.health())["devices"]["S1"]
    recovered_s = await gateway.used("S1", "S2")
    late = sum(after[key] - before[key] for key in ("late", "dropped"))
    return Outcome(0.0, recovered_s, gateway.pose_gap_s(since), late)


SCENARIO = Scenario(
    title="USB adapter that delivers samples in pairs",
    reported="not a fault; visible in `jitter_us` of the device",
    continues="poses from both sensors",
    counted="late samples; the figure is the sum of `late` and `dropped` of one sensor",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=1.0,
    gap_limit_s=0.2,
)
