"""The daemon has no free file descriptor when a sensor is plugged in."""

from __future__ import annotations

import asyncio
import resource
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Unplug S1, use all free descriptors of the daemon, and release them."""
    since, device = len(gateway.listener.poses), gateway.sensors["S1"].device
    device.unplug()
    await gateway.seconds(lambda: "S1" not in gateway.listener.online)
    limits = resource.prlimit(gateway.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(gateway.pid, resource.RLIMIT_NOFILE, (3, limits[1]))
    gateway.listener.events.clear()
    device.plug()
    noticed_s = await gateway.seconds(
        lambda: gateway.listener.find_event("S1", "no file descriptor left")
    )
    await asyncio.sleep(1.0)
    resource.prlimit(gateway.pid, resource.RLIMIT_NOFILE, limits)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="no file descriptor left",
    reported="`bridge/event`, with the remedy",
    continues="poses from the other sensor, and every open connection",
    counted="samples while unplugged",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=4.0,
    gap_limit_s=0.2,
)
