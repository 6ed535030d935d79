"""Programs send a thousand requests a second."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import aiomqtt

from tests.faults.gateway import BASE
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

RATE_HZ = 1000
"""Requests per second."""
REQUESTS = (
    ("selftest", b"{}"),
    ("calibrations", b'{"count": 5}'),
    ("calibrate", b'{"phase": "nothing"}'),
    ("rate", b'{"hz": 1e300}'),
    ("restart-device", b'{"device": "\\u0000"}'),
    ("unknown", b"[" * 5000),
    ("record", b"\\xff" * 300),
)
"""Topic and payload of each request that is sent in turn."""


async def run(gateway: Gateway) -> Outcome:
    """Send requests of all kinds, valid and not, for five seconds."""
    since = len(gateway.listener.poses)
    before = (await gateway.health())["devices"]["S1"]
    loop = asyncio.get_running_loop()
    async with aiomqtt.Client("127.0.0.1", gateway.broker.port) as client:
        began_s, sent = loop.time(), 0
        while (elapsed_s := loop.time() - began_s) < 5.0:
            while sent < elapsed_s * RATE_HZ:
                topic, payload = REQUESTS[sent % len(REQUESTS)]
                await client.publish(f"{BASE}/bridge/request/{topic}", payload)
                sent += 1
            await asyncio.sleep(0.005)
    recovered_s = await gateway.fresh_pose()
    after = (await gateway.health())["devices"]["S1"]
    lost = sum(after[key] - before[key] for key in ("lost", "late", "dropped"))
    return Outcome(0.0, recovered_s, gateway.pose_gap_s(since), lost)


SCENARIO = Scenario(
    title="5000 requests in five seconds",
    reported="answers; `ignored_requests` of the link",
    continues="poses from both sensors",
    counted="samples; the figure is the sum of `lost`, `late` and `dropped` of one sensor",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=1.0,
    gap_limit_s=0.3,
)
