"""The camera software plays a recording of one second in a loop."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Play three rounds of a recording."""
    since, cameras = len(gateway.listener.poses), gateway.cameras
    before = await gateway.device("mocap")
    number, lag_ns = cameras.server.number, cameras.lag_ns
    cameras.server.edit_mode = True
    noticed_s = 0.0
    for _ in range(3):
        cameras.server.number, cameras.lag_ns = number, cameras.lag_ns + 1_000_000_000
        waited_s = await gateway.seconds(
            lambda: (
                gateway.listener.latest["bridge/health"]["devices"]["mocap"]["restarts"]
                > before["restarts"]
            )
        )
        noticed_s = noticed_s or waited_s
        await asyncio.sleep(1.0)
    cameras.server.edit_mode, cameras.lag_ns = False, lag_ns
    recovered_s = await gateway.streaming("mocap")
    after = await gateway.device("mocap")
    return Outcome(
        noticed_s, recovered_s, gateway.pose_gap_s(since), after["lost"] - before["lost"]
    )


SCENARIO = Scenario(
    title="camera software that plays a recording in a loop",
    reported="`bridge/event`; `restarts` of the device",
    continues="poses from the sensors; the frames are not used",
    counted="nothing, because a repeated frame is not a loss; the figure is `lost` of the device",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
    kind="all",
)
