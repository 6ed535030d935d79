"""The daemon is stopped at a random moment of its start."""

from __future__ import annotations

import asyncio
import random
import signal
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

MOMENTS = random.Random(7)
"""Source of the random moments and signals, which are the same in every series of runs."""


async def run(gateway: Gateway) -> Outcome:
    """Stop the daemon, start it, stop it by a random signal at a random moment, and start it."""
    await gateway.stop()
    number = MOMENTS.choice((signal.SIGTERM, signal.SIGKILL))
    await gateway.launch()
    await asyncio.sleep(MOMENTS.uniform(0.0, 3.0))
    noticed_s = await gateway.stop(number)
    recovered_s = await gateway.start()
    assert "Traceback" not in gateway.log, gateway.log
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="SIGTERM or SIGKILL at a random moment of the start",
    reported="`bridge/state`; *noticed* is the time to the exit",
    continues="nothing",
    counted="nothing",
    run=run,
    noticed_limit_s=5.0,
    recovered_limit_s=20.0,
)
