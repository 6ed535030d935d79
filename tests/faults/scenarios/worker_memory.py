"""The process of a fit has too little memory."""

from __future__ import annotations

import resource
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

LIMIT_BYTES = 30_000_000
"""Address space of the worker, bytes, which is too small for SciPy."""


async def run(gateway: Gateway) -> Outcome:
    """Limit the address space of the worker process that fits a static phase."""
    since = len(gateway.listener.poses)
    for worker in await gateway.start_fit():
        resource.prlimit(worker, resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    noticed_s = await gateway.seconds(
        lambda: (
            "Error" in gateway.listener.latest["calibration"]["text"]
            or "without a result" in gateway.listener.latest["calibration"]["text"]
        )
    )
    gateway.rest(resting=False)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="process of a fit at its memory limit",
    reported="`calibration`, with the error",
    continues="poses with the calibration in force",
    counted="nothing: the phase can be repeated",
    run=run,
    noticed_limit_s=5.0,
    recovered_limit_s=0.5,
    gap_limit_s=0.2,
)
