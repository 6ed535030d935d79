"""A sensor reboots: its clock and counter begin at zero."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Interrupt the power of S1."""
    since = len(gateway.listener.poses)
    before = (await gateway.health())["devices"]["S1"]
    gateway.listener.events.clear()
    gateway.sensors["S1"].device.power_cycle()
    noticed_s = await gateway.seconds(lambda: gateway.listener.find_event("S1"))
    recovered_s = await gateway.used("S1", "S2")
    await asyncio.sleep(0.5)
    after = (await gateway.health())["devices"]["S1"]
    return Outcome(
        noticed_s, recovered_s, gateway.pose_gap_s(since), after["dropped"] - before["dropped"]
    )


SCENARIO = Scenario(
    title="sensor rebooted, with its clock at zero",
    reported="`bridge/event`",
    continues="poses from the other sensor",
    counted="waiting samples of the old clock; counter `dropped` of the device",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
)
