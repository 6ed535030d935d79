"""The camera software starts with a bitstream that no driver knows."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Start the server with bitstream 5.0 for a second, then with 3.1."""
    since, cameras = len(gateway.listener.poses), gateway.cameras
    gateway.listener.events.clear()
    cameras.set_options(bitstream=(5, 0))
    cameras.server.set_bitstream((5, 0))
    cameras.server.restart()
    noticed_s = await gateway.seconds(
        lambda: gateway.listener.find_event("mocap", "newer than this driver")
    )
    await asyncio.sleep(1.0)
    cameras.set_options(bitstream=(3, 1))
    cameras.server.set_bitstream((3, 1))
    cameras.server.restart()
    await asyncio.sleep(0.5)
    recovered_s = await gateway.streaming("mocap")
    await asyncio.sleep(1.5)  # a working server resets the pause between attempts
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="camera software with a newer bitstream than the driver knows",
    reported="`bridge/event`, with the remedy",
    continues="poses from the sensors; frames as far as they can be decoded",
    counted="`corrupt` of the device",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=7.0,
    gap_limit_s=0.2,
    kind="all",
)
