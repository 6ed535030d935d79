"""Another program changes the mode of the port: reads return no bytes."""

from __future__ import annotations

import asyncio
import os
import termios
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

END = b"\x04"
"""End-of-file character of a terminal in line mode."""


async def run(gateway: Gateway) -> Outcome:
    """Switch the port of S1 to line mode, and send the end-of-file character."""
    since, before = len(gateway.listener.poses), await gateway.device("S1")
    port = os.open(gateway.folder / "S1", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        mode = termios.tcgetattr(port)
        mode[3] |= termios.ICANON
        mode[6][termios.VEOF] = END
        termios.tcsetattr(port, termios.TCSANOW, mode)
    finally:
        os.close(port)
    line = gateway.sensors["S1"].device
    line._line.write(END * 3)
    noticed_s = await gateway.seconds(lambda: "S1" not in gateway.listener.online)
    recovered_s = await gateway.used("S1", "S2")
    await asyncio.sleep(0.2)
    after = await gateway.device("S1")
    lost = after["reconnects"] - before["reconnects"]
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), lost)


SCENARIO = Scenario(
    title="reads of a serial port that return no bytes",
    reported="`device/S1/availability`, `bridge/event`",
    continues="poses from the other sensor",
    counted="samples while the port is closed; the figure is `reconnects` of the device",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=2.0,
    gap_limit_s=0.2,
)
