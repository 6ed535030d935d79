"""The file system of the recordings is full."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from tests.faults.gateway import DISK_MB, no_namespace
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Fill the file system, and free it."""
    since = len(gateway.listener.poses)
    before = (await gateway.health())["recording"]
    filler = gateway.in_namespace(gateway.folder / "recordings" / "filler")
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        for _ in range(DISK_MB * 256):
            file.write(bytes(4096))
    noticed_s = await gateway.seconds(recording_fails(gateway))
    await asyncio.sleep(1.0)
    filler.unlink()
    recovered_s = await gateway.seconds(lambda: not recording_fails(gateway)())
    await gateway.remove_old_recordings()
    after = (await gateway.health())["recording"]
    lost = after["lost"] - before["lost"]
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), lost)


def recording_fails(gateway: Gateway) -> Callable[[], object]:
    """Return a function that returns the failure that the recorder reports, if any."""
    return lambda: gateway.listener.latest["bridge/health"]["recording"]["failure"]


SCENARIO = Scenario(
    title="disk full",
    reported="`recording.failure` in `bridge/health`, `bridge/event`",
    continues="poses from both sensors",
    counted="messages; the figure is `recording.lost`; the recording has a gap",
    run=run,
    noticed_limit_s=5.0,
    recovered_limit_s=5.0,
    gap_limit_s=0.2,
    kind="host",
    missing=no_namespace,
)
