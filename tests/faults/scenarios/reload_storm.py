"""rig.toml is loaded again and again; every second time it has a fault."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Reload forty times in two seconds, with alternating settings and faults."""
    since, text = len(gateway.listener.poses), gateway.rig.read_text("utf-8")
    variants = (
        f"{text}file_mb = 500\n", text.replace("[chain]", "[chian]"), text,
        text[: len(text) // 2],
    )  # fmt: skip
    for number in range(40):
        gateway.rig.write_text(variants[number % len(variants)], "utf-8")
        gateway.reload()
        await asyncio.sleep(0.05)
    gateway.rig.write_text(text, "utf-8")
    gateway.listener.events.clear()
    gateway.reload()
    recovered_s = await gateway.fresh_pose()
    await gateway.streaming("S1")
    assert (await gateway.request("reload"))["status"] == "ok"
    return Outcome(0.0, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="40 reloads in two seconds, half of them of a faulty rig.toml",
    reported="`bridge/event`",
    continues="poses from both sensors",
    counted="nothing",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=1.0,
    gap_limit_s=0.5,
)
