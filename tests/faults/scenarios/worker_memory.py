"""The process of a fit gets no memory."""

from __future__ import annotations

import asyncio
import resource
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario
from tests.faults.scenarios.worker_killed import children

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

LIMIT_BYTES = 30_000_000
"""Address space of the worker, bytes: SciPy does not fit."""


async def run(gateway: Gateway) -> Outcome:
    """Limit the address space of the worker of a static phase."""
    since = len(gateway.listener.poses)
    gateway.rest(resting=True)
    await asyncio.sleep(0.5)
    answer = await gateway.request("calibrate", phase="static", seconds=2.0, force=True)
    assert answer["status"] == "accepted", answer
    loop = asyncio.get_running_loop()
    until_s = loop.time() + 30.0
    while not (workers := children(gateway.pid)):
        assert loop.time() < until_s, "no worker was started"
        await asyncio.sleep(0.002)
    for worker in workers:
        resource.prlimit(worker, resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    noticed_s = await gateway.seconds(
        lambda: (
            gateway.listener.latest["calibration"]["phase"] == "failed"
            or "Error" in gateway.listener.latest["calibration"]["text"]
            or "without a result" in gateway.listener.latest["calibration"]["text"]
        )
    )
    gateway.rest(resting=False)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="memory limit of the process of a fit",
    reported="`calibration`, with the error",
    continues="poses with the calibration in force",
    counted="nothing: the phase can be repeated",
    run=run,
    noticed_limit_s=5.0,
    recovered_limit_s=0.5,
    gap_limit_s=0.2,
)
