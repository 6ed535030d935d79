"""The camera software is updated: it starts again with another bitstream."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Start the server again with bitstream 4.1."""
    since, cameras = len(gateway.listener.poses), gateway.cameras
    before = await gateway.device("mocap")
    cameras.server.unplug()
    noticed_s = await gateway.seconds(lambda: "mocap" not in gateway.listener.online)
    cameras.set_options(bitstream=(4, 1))
    cameras.server.set_bitstream((4, 1))
    cameras.server.restart()
    recovered_s = await gateway.streaming("mocap")
    after = await gateway.device("mocap")

    cameras.set_options(bitstream=(3, 1))
    cameras.server.set_bitstream((3, 1))
    cameras.server.restart()
    await asyncio.sleep(1.0)
    await gateway.streaming("mocap")
    corrupt = after["corrupt"] - before["corrupt"]
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), corrupt)


SCENARIO = Scenario(
    title="camera software started again with another bitstream",
    reported="`device/mocap/availability`, `bridge/event`",
    continues="poses from the sensors",
    counted="nothing; the figure is `corrupt` of the device",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
    kind="all",
)
