"""rig.toml names a server that no network card reaches."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Write an address into rig.toml that no host has (RFC 5737); reload, correct it, reload."""
    since, text = len(gateway.listener.poses), gateway.rig.read_text("utf-8")
    wrong = text.replace('server = "127.0.0.1"', 'server = "192.0.2.77"\ninterface = "127.0.0.1"')
    gateway.rig.write_text(wrong, "utf-8")
    gateway.listener.events.clear()
    gateway.reload()
    noticed_s = await gateway.seconds(lambda: gateway.listener.find_event("mocap", "192.0.2.77"))
    await asyncio.sleep(1.0)
    gateway.rig.write_text(text, "utf-8")
    gateway.reload()
    recovered_s = await gateway.streaming("mocap")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="cameras in a subnet that the network card does not reach",
    reported="`bridge/event`, with the address",
    continues="poses from the sensors",
    counted="nothing",
    run=run,
    noticed_limit_s=4.0,
    recovered_limit_s=2.0,
    gap_limit_s=0.3,
    kind="all",
)
