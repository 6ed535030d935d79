"""The network between daemon and broker loses 30 % of the segments."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.faulty_link import faulty_link
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Lose segments for five seconds."""
    async with faulty_link(gateway) as link:
        before = (await gateway.health())["link"]
        link.loss = 0.3
        count = len(gateway.listener.poses)
        await asyncio.sleep(5.0)
        assert len(gateway.listener.poses) > count, "no pose arrived"
        link.loss = 0.0
        recovered_s = await gateway.fresh_pose()
        after = (await gateway.health())["link"]
    return Outcome(0.0, recovered_s, 0.0, after["dropped"] - before["dropped"])


SCENARIO = Scenario(
    title="network to the broker that loses 30 % of the segments",
    reported="not a fault until poses are dropped; then `dropped` of the link",
    continues="everything; poses arrive late",
    counted="poses; counter `dropped` of the link",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=2.0,
)
