"""The CAN adapter is unplugged and plugged in again."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Unplug the adapter for a second."""
    since, before = len(gateway.listener.poses), await gateway.device("S3")
    sent = gateway.can.device.sent
    gateway.can.bus.unplug()
    noticed_s = await gateway.seconds(lambda: "S3" not in gateway.listener.online)
    await asyncio.sleep(1.0)
    gateway.can.bus.plug()
    recovered_s = await gateway.used("S3")
    after = await gateway.device("S3")
    lost = gateway.can.device.sent - sent - (after["received"] - before["received"])
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), max(0, lost))


SCENARIO = Scenario(
    title="CAN adapter unplugged for a second",
    reported="`device/S3/availability`, `bridge/event`",
    continues="poses from the other sensors",
    counted="samples while unplugged; counter `reconnects` of the device",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
    kind="all",
)
