"""The broker answers that its quota is used up."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

QUOTA_EXCEEDED = b"\x20\x03\x00\x97\x00"
"""CONNACK of MQTT 5 with reason code 151."""


async def run(gateway: Gateway) -> Outcome:
    """Answer every connection with the reason code for a used-up quota."""
    since = len(gateway.log)

    async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)
        writer.write(QUOTA_EXCEEDED)
        await writer.drain()
        await reader.read(1000)
        writer.close()

    async with gateway.other_server(refuse):
        noticed_s = await gateway.logged("quota", since)
        await asyncio.sleep(1.0)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="broker whose quota is used up",
    reported="log, with the cause",
    continues="acquisition, fusion and recording",
    counted="poses of the outage",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=1.0,
)
