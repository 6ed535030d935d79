"""A durable write takes two seconds."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Delay writes for six seconds."""
    since = len(gateway.listener.poses)
    before = (await gateway.health())["recording"]
    gateway.inject(write_s=2.0)
    backlog, began_s = 0, time.monotonic()
    while time.monotonic() < began_s + 6.0:  # the backlog falls after each write
        backlog = max(backlog, (await gateway.health())["recording"]["backlog_bytes"])
    gateway.inject()
    recovered_s = await gateway.seconds(
        lambda: gateway.listener.latest["bridge/health"]["recording"]["backlog_bytes"] < backlog / 2
    )
    after = (await gateway.health())["recording"]
    await gateway.remove_old_recordings()
    return Outcome(0.0, recovered_s, gateway.pose_gap_s(since), after["lost"] - before["lost"])


SCENARIO = Scenario(
    title="disk whose writes take two seconds",
    reported="`recording.backlog_bytes` in `bridge/health`",
    continues="everything",
    counted="messages; the figure is `recording.lost`",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=5.0,
    gap_limit_s=0.2,
    kind="host",
)
