"""A sensor sends the same orientation again and again."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Make S1 repeat its orientation until the daemon reports it, and half a second more."""
    sensor, since = gateway.sensors["S1"], len(gateway.listener.poses)

    def state() -> object:
        return gateway.listener.latest["bridge/health"]["devices"]["S1"]["sensor"]

    await gateway.seconds(lambda: state() == "ok")
    sensor.stuck_at = sensor.number
    noticed_s = await gateway.seconds(lambda: state() == "stuck")
    await asyncio.sleep(0.5)
    sensor.stuck_at = None
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="stuck sensor",
    reported="`bridge/event`, `sensor` of the device in `bridge/health`",
    continues="poses from the other sensor",
    counted="nothing: its samples are received but not used",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
)
