"""A second sensor with the same CAN identifiers joins the bus."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Send from the second sensor until the daemon reports it, and a second more."""
    since = len(gateway.listener.poses)
    twin = XcdiDevice(gateway.can.bus, XcdiDeviceOptions(first_counter=31_000, first_tick=31_000))
    gateway.listener.events.clear()

    async def send() -> None:
        began_s, number = time.monotonic(), 0
        while True:
            while number < (time.monotonic() - began_s) * 100:
                number += 1
                twin.push(number * 10_000_000, (0.0, 1.0, 0.0, 0.0))
            await asyncio.sleep(0.005)

    sending = asyncio.create_task(send())
    noticed_s = await gateway.seconds(
        lambda: gateway.listener.find_event("S3", "two sensors use the same CAN identifiers")
    )
    await asyncio.sleep(1.0)
    sending.cancel()
    await asyncio.wait([sending])
    recovered_s = await gateway.used("S3")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="two sensors with the same CAN identifiers",
    reported="`bridge/event`, with the remedy",
    continues="poses from the other sensors",
    counted="`corrupt` of the device",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=3.0,
    gap_limit_s=0.2,
    kind="all",
)
