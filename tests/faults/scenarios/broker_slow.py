"""The connection to the broker transmits a tenth of the bytes that the daemon sends."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.faulty_link import faulty_link
from tests.faults.scenario import Outcome, Scenario
from tests.faults.scenarios.broker_frozen import resident_bytes

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

SLOW_BYTES_PER_S = 8_000
"""Rate of the connection, bytes/s; the daemon sends about ten times as many."""


async def run(gateway: Gateway) -> Outcome:
    """Limit the rate until the daemon drops a message, and six seconds more."""
    memory = resident_bytes(gateway.pid)
    async with faulty_link(gateway) as link:
        before = (await gateway.health())["link"]
        link.bytes_per_s = SLOW_BYTES_PER_S
        noticed_s = await gateway.link_dropped()
        await asyncio.sleep(6.0)
        grown = resident_bytes(gateway.pid) - memory
        link.bytes_per_s = None
        recovered_s = await gateway.fresh_pose()
        after = (await gateway.health())["link"]
    assert grown < 16_000_000, f"memory grew by {grown} bytes"
    return Outcome(noticed_s, recovered_s, 0.0, after["dropped"] - before["dropped"])


SCENARIO = Scenario(
    title="slow connection to the broker",
    reported="`dropped` and `queued` of the link in `bridge/health`",
    continues="acquisition, fusion, recording; the newest poses; memory grows by less than 16 MB",
    counted="poses; counter `dropped` of the link",
    run=run,
    noticed_limit_s=20.0,
    recovered_limit_s=2.0,
)
