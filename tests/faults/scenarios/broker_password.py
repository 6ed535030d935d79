"""The broker refuses the daemon's credentials."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.broker_fixture import MosquittoBroker
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Replace the broker by a mosquitto that wants a password."""
    refusing = MosquittoBroker(
        gateway.folder, port=gateway.broker.port, more="allow_anonymous false\n"
    )
    since = len(gateway.log)
    with gateway.other_broker(refusing):
        noticed_s = await gateway.logged("correct username and password_file", since)
        await asyncio.sleep(1.0)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="broker that refuses the credentials",
    reported="log, with the keys to correct",
    continues="acquisition, fusion and recording",
    counted="poses of the outage",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=1.0,
    missing=MosquittoBroker.missing,
)
