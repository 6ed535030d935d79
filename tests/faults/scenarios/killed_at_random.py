"""The daemon is killed at a random moment of a calibration with recording."""

from __future__ import annotations

import asyncio
import random
import signal
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway

MOMENTS = random.Random(11)
"""Source of the random moments. Every series of runs has the same moments."""


async def run(gateway: Gateway) -> Outcome:
    """Kill the daemon during a static phase, its fit or its storage."""
    rig = load_rig(gateway.rig)
    store = CalibrationStore(gateway.folder / "state" / "calibrations", rig.calibration_store)
    versions = store.versions()
    gateway.rest(resting=True)
    await asyncio.sleep(0.5)
    answer = await gateway.request("calibrate", phase="static", seconds=1.0, force=True)
    assert answer["status"] == "accepted", answer
    await asyncio.sleep(MOMENTS.uniform(0.5, 4.0))
    noticed_s = await gateway.stop(signal.SIGKILL)
    gateway.rest(resting=False)
    broken = gateway.unfinished_recordings()
    assert store.versions()[: len(versions)] == versions
    recovered_s = await gateway.start()
    for version in store.versions():
        store.load(version)
    await gateway.seconds(lambda: not broken & gateway.unfinished_recordings())
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="SIGKILL at a random moment of a calibration",
    reported="`bridge/state`; *noticed* is the time to the exit",
    continues="nothing",
    counted="the calibration in progress; stored ones remain readable",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=20.0,
)
