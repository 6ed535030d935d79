"""A firewall drops the datagrams of the camera server in both directions."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Drop datagrams until the daemon names the firewall, and a second more."""
    since, server = len(gateway.listener.poses), gateway.cameras.server
    server.firewall = True
    noticed_s = await gateway.seconds(lambda: "mocap" not in gateway.listener.online)
    await gateway.event("mocap", "no answer within", "firewall")
    await asyncio.sleep(1.0)
    server.firewall = False
    recovered_s = await gateway.streaming("mocap")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="firewall that drops the datagrams of the cameras",
    reported="`device/mocap/availability`; `bridge/event` names the firewall as one cause",
    continues="poses from the sensors",
    counted="frames; counter `reconnects` of the device",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=4.0,
    gap_limit_s=0.2,
    kind="all",
)
