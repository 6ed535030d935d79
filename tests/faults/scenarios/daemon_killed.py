"""The daemon is killed and started again."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Kill and start the daemon."""
    noticed_s = await gateway.stop(signal.SIGKILL)
    noticed_s += await gateway.seconds(
        lambda: gateway.listener.latest["bridge/state"]["state"] == "offline"
    )
    broken = gateway.unfinished_recordings()
    recovered_s = await gateway.start()
    await gateway.seconds(lambda: not broken & gateway.unfinished_recordings())
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="daemon killed and started again",
    reported="`bridge/state`, published by the broker (MQTT will)",
    continues="nothing",
    counted="at most a second of the recording, which is repaired",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=20.0,
)
