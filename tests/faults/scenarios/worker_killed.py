"""The process of a calibration fit is killed."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Kill the worker process that fits a static phase."""
    since = len(gateway.listener.poses)
    for worker in await gateway.start_fit():
        os.kill(worker, signal.SIGKILL)
    noticed_s = await gateway.seconds(
        lambda: (
            "worker process ended with exit code -9"
            in gateway.listener.latest["calibration"]["text"]
        )
    )
    gateway.rest(resting=False)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="process of a fit killed",
    reported="`calibration`, with the exit code",
    continues="poses with the calibration in force",
    counted="nothing: the phase can be repeated",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=0.5,
    gap_limit_s=0.2,
)
