"""UNIX time is set forward by an hour."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Step UNIX time forward by an hour, and back again."""
    return await step(gateway, 3600.0)


async def step(gateway: Gateway, seconds: float) -> Outcome:
    """Step UNIX time by `seconds` until poses have the new time, and undo the step."""
    since = len(gateway.listener.poses)
    before = (await gateway.health())["devices"]["S1"]
    gateway.inject(step_s=seconds)
    noticed_s = await gateway.seconds(lambda: abs(offset_s(gateway) - seconds) < 1.0)
    seqs = [pose["seq"] for pose in gateway.listener.poses[since:]]
    after = (await gateway.health())["devices"]["S1"]
    gateway.inject()
    recovered_s = await gateway.seconds(lambda: abs(offset_s(gateway)) < 1.0)
    assert seqs == sorted(set(seqs))
    lost = sum(after[key] - before[key] for key in ("lost", "late", "dropped", "restarts"))
    return Outcome(noticed_s, recovered_s, 0.0, lost)


def offset_s(gateway: Gateway) -> float:
    """Return the time of the newest pose minus UNIX time, s."""
    newest: float = gateway.listener.poses[-1]["t_us"] * 1e-6
    return newest - time.time()


SCENARIO = Scenario(
    title="UNIX time set forward by an hour",
    reported="no report; *noticed* is the time until poses have the new UNIX time",
    continues="everything",
    counted="nothing; the figure is `lost` + `late` + `dropped` + `restarts` of one sensor",
    run=run,
    noticed_limit_s=1.5,
    recovered_limit_s=1.5,
    kind="host",
)
