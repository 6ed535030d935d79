"""One message in ten has a wrong bit."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Corrupt messages of S1 until the daemon counts a corrupt one, and two seconds more."""
    sensor, since = gateway.sensors["S1"], len(gateway.listener.poses)
    before, sent = (await gateway.health())["devices"]["S1"], sensor.device.sent
    sensor.corrupted_share = 0.1
    noticed_s = await gateway.seconds(
        lambda: (
            gateway.listener.latest["bridge/health"]["devices"]["S1"]["corrupt"] > before["corrupt"]
        )
    )
    await asyncio.sleep(2.0)
    sensor.corrupted_share = 0.0
    recovered_s = await gateway.used("S1", "S2")
    after = (await gateway.health())["devices"]["S1"]
    lost = sensor.device.sent - sent - (after["received"] - before["received"])
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), max(0, lost))


SCENARIO = Scenario(
    title="a wrong bit in one message of ten",
    reported="`corrupt` of the device in `bridge/health`",
    continues="poses from both sensors",
    counted="corrupt messages; counters `corrupt` and `lost` of the device",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=0.5,
    gap_limit_s=0.2,
)
