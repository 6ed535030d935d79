"""Other devices on the bus of the sensor send at the full rate of the bus."""

from __future__ import annotations

import asyncio
import random
import time
from typing import TYPE_CHECKING

from jointfit_protocols.can import CanFrame
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

FRAMES_HZ = 3700
"""Number of frames with eight data bytes that fill a bus of 500 kbit/s, frames/s."""
STRANGERS = (0x000, 0x010, 0x123, 0x456, 0x7FF, 0x18FF1234)
"""Identifiers that no sensor uses."""


async def run(gateway: Gateway) -> Outcome:
    """Send frames of other devices at 500 kbit/s for three seconds."""
    since, before = len(gateway.listener.poses), await gateway.device("S3")
    sent, bus, source = gateway.can.device.sent, gateway.can.bus, random.Random(2)
    began_s, frames = time.monotonic(), 0
    while (elapsed_s := time.monotonic() - began_s) < 3.0:
        while frames < elapsed_s * FRAMES_HZ:
            number = source.choice(STRANGERS)
            bus.send([CanFrame(0, number, source.randbytes(8), number > 0x7FF)])
            frames += 1
        await asyncio.sleep(0.002)
    recovered_s = await gateway.used("S3")
    after = await gateway.device("S3")
    lost = gateway.can.device.sent - sent - (after["received"] - before["received"])
    return Outcome(0.0, recovered_s, gateway.pose_gap_s(since), max(0, lost))


SCENARIO = Scenario(
    title="CAN bus at full load from other devices",
    reported="not a fault of the sensor",
    continues="poses from all sensors",
    counted="samples; the figure is the number of samples that were sent but not received",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=0.5,
    gap_limit_s=0.2,
    kind="all",
)
