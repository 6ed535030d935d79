"""The daemon is stopped by SIGTERM and started again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Stop and start the daemon."""
    noticed_s = await gateway.stop()
    assert gateway.listener.latest["bridge/state"]["state"] == "offline"
    unfinished = gateway.unfinished_recordings()
    recovered_s = await gateway.start()
    return Outcome(noticed_s, recovered_s, 0.0, len(unfinished))


SCENARIO = Scenario(
    title="daemon stopped by SIGTERM and started again",
    reported="`bridge/state`",
    continues="nothing",
    counted="nothing; the figure is the number of unfinished recordings",
    run=run,
    noticed_limit_s=5.0,
    recovered_limit_s=20.0,
)
