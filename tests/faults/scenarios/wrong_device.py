"""Another device is on the port after a sensor was unplugged."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from jointfit_simulators.wires import PtyLine
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Replace S1 by a GNSS receiver, then by S1 again."""
    device, since = gateway.sensors["S1"].device, len(gateway.listener.poses)
    device.unplug()
    await gateway.seconds(lambda: "S1" not in gateway.listener.online)
    line = PtyLine(gateway.folder / "S1")

    async def send() -> None:
        while True:
            line.write(b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n")
            await asyncio.sleep(0.1)

    sending = asyncio.create_task(send())
    try:
        noticed_s = await gateway.event("S1", "is not Xbus")
    finally:
        sending.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await sending
        line.unplug()
    device.plug()
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="another device on the port",
    reported="`bridge/event`, with the finding and the remedy",
    continues="poses from the other sensor",
    counted="nothing",
    run=run,
    noticed_limit_s=20.0,
    recovered_limit_s=4.0,
    gap_limit_s=0.2,
)
