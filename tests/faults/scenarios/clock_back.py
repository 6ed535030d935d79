"""UNIX time is set back by an hour."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario
from tests.faults.scenarios.clock_forward import step

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Step UNIX time back by an hour, and forward again."""
    return await step(gateway, -3600.0)


SCENARIO = Scenario(
    title="UNIX time set back by an hour",
    reported="no report; *noticed* is the time until poses have the new UNIX time",
    continues="everything",
    counted="nothing; the figure is `lost` + `late` + `dropped` + `restarts` of one sensor",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=1.5,
    kind="host",
)
