"""The server sends an occluded marker as zeros."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Occlude a marker for two seconds; the server sends it as zeros."""
    since, cameras = len(gateway.listener.poses), gateway.cameras
    before = await gateway.device("mocap")
    cameras.set_options(hiding="zeros")
    cameras.hidden = True
    await asyncio.sleep(2.0)
    cameras.hidden = False
    cameras.set_options(hiding="missing")
    recovered_s = await gateway.streaming("mocap")
    after = await gateway.device("mocap")
    lost = sum(after[key] - before[key] for key in ("corrupt", "reconnects", "restarts"))
    return Outcome(0.0, recovered_s, gateway.pose_gap_s(since), lost)


SCENARIO = Scenario(
    title="occluded marker sent as zeros",
    reported="not a fault: the marker is absent in these frames",
    continues="everything",
    counted="nothing; the figure is `corrupt` + `reconnects` + `restarts` of the cameras",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=1.0,
    gap_limit_s=0.2,
    kind="all",
)
