"""The camera software is closed and started again."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Close the server for a second."""
    since, before = len(gateway.listener.poses), await gateway.device("mocap")
    gateway.cameras.server.unplug()
    noticed_s = await gateway.seconds(lambda: "mocap" not in gateway.listener.online)
    await asyncio.sleep(1.0)
    gateway.cameras.server.restart()
    recovered_s = await gateway.streaming("mocap")
    after = await gateway.device("mocap")
    lost = after["lost"] - before["lost"]
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), lost)


SCENARIO = Scenario(
    title="camera software closed for a second",
    reported="`device/mocap/availability`, `bridge/event`",
    continues="poses from the sensors",
    counted="frames while closed; counter `reconnects` of the device; the figure is `lost`",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=2.0,
    recovered_median_s=0.5,
    gap_limit_s=0.2,
    kind="all",
)
