"""The process of a calibration fit is killed."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


def children(pid: int) -> list[int]:
    """Return the processes that a process has started and that run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            text = path.read_text("utf-8", "replace")
            if int(text.rpartition(")")[2].split()[1]) == pid:
                found.append(int(path.parent.name))
    return found


async def run(gateway: Gateway) -> Outcome:
    """Kill the worker of a static phase, and repeat the phase."""
    since = len(gateway.listener.poses)
    gateway.rest(resting=True)
    await asyncio.sleep(0.5)
    answer = await gateway.request("calibrate", phase="static", seconds=2.0, force=True)
    assert answer["status"] == "accepted", answer
    loop = asyncio.get_running_loop()
    until_s = loop.time() + 30.0
    while not (workers := children(gateway.pid)):
        assert loop.time() < until_s, "no worker was started"
        await asyncio.sleep(0.002)
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    noticed_s = await gateway.seconds(
        lambda: (
            "worker process ended with exit code -9"
            in gateway.listener.latest["calibration"]["text"]
        )
    )
    gateway.rest(resting=False)
    recovered_s = await gateway.used("S1", "S2")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="process of a fit killed",
    reported="`calibration`, with the exit code",
    continues="poses with the calibration in force",
    counted="nothing: the phase can be repeated",
    run=run,
    noticed_limit_s=2.0,
    recovered_limit_s=0.5,
    gap_limit_s=0.2,
)
