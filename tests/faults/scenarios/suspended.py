"""The daemon does not run for three seconds, as on a host that was suspended."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Stop the process of the daemon by a signal, and continue it after three seconds."""
    before = (await gateway.health())["devices"]["S1"]
    os.kill(gateway.pid, signal.SIGSTOP)
    await asyncio.sleep(3.0)
    os.kill(gateway.pid, signal.SIGCONT)
    recovered_s = await gateway.fresh_pose()
    await asyncio.sleep(0.5)
    after = (await gateway.health())["devices"]["S1"]
    lost = sum(after[key] - before[key] for key in ("lost", "late", "dropped"))
    return Outcome(0.0, recovered_s, 0.0, lost)


SCENARIO = Scenario(
    title="daemon stopped for three seconds",
    reported="log; `lost` and `late` of the devices",
    continues="nothing",
    counted="samples; the figure is the sum of `lost`, `late` and `dropped` of one sensor",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=3.0,
)
