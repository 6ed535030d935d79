"""A sensor is unplugged and plugged in again."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Unplug S1 for a second."""
    sensor, since = gateway.sensors["S1"], len(gateway.listener.poses)
    before = (await gateway.health())["devices"]["S1"]
    sent = sensor.device.sent
    sensor.device.unplug()
    noticed_s = await gateway.seconds(lambda: "S1" not in gateway.listener.online)
    await asyncio.sleep(1.0)
    sensor.device.plug()
    recovered_s = await gateway.used("S1", "S2")
    after = (await gateway.health())["devices"]["S1"]
    received = after["received"] - before["received"]
    return Outcome(
        noticed_s,
        recovered_s,
        gateway.pose_gap_s(since),
        max(0, sensor.device.sent - sent - received),
    )


SCENARIO = Scenario(
    title="serial sensor unplugged for a second",
    reported="`device/S1/availability`, `bridge/event`",
    continues="poses from the other sensor",
    counted="samples while unplugged; counter `reconnects` of the device",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=2.0,
    recovered_median_s=0.5,
    gap_limit_s=0.2,
)
