"""The operator adds a skeleton whose markers have the same names as those of the rigid body."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Describe a skeleton until the daemon reports it, and a second more."""
    since, cameras = len(gateway.listener.poses), gateway.cameras
    gateway.listener.events.clear()
    cameras.server.skeleton = True
    cameras.set_options()
    noticed_s = await gateway.seconds(lambda: gateway.listener.find_event("mocap", "T1"))
    await asyncio.sleep(1.0)
    cameras.server.skeleton = False
    cameras.set_options()
    recovered_s = await gateway.streaming("mocap")
    await asyncio.sleep(2.5)  # the driver asks for the model once a second
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="skeleton with the marker names of a rigid body",
    reported="`bridge/event`",
    continues="poses from the sensors",
    counted="nothing",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
    kind="all",
)
