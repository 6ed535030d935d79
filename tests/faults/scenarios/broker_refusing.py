"""Another program accepts connections on the broker's port and closes them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Replace the broker by a server that closes every connection."""

    async def refuse(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()

    async with gateway.other_server(refuse):
        noticed_s = await gateway.disconnected()
        await asyncio.sleep(1.0)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="broker that closes every connection",
    reported="log",
    continues="acquisition, fusion and recording",
    counted="poses of the outage",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=1.0,
)
