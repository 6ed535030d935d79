"""The file system of the recordings is read-only."""

from __future__ import annotations

import asyncio
import subprocess
from typing import TYPE_CHECKING

from tests.faults.gateway import no_namespace
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Make the file system read-only, request a recording, and make the file system writable."""
    since = len(gateway.listener.poses)
    await gateway.request("record", action="stop")
    remount(gateway, "ro")
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    answer = await gateway.request("record", action="start")
    assert answer["status"] == "error", answer
    assert "ead-only" in answer["error"]["message"], answer
    noticed_s = loop.time() - began_s
    remount(gateway, "rw")
    began_s = loop.time()
    answer = await gateway.request("record", action="start")
    assert answer["status"] == "ok", answer
    recovered_s = loop.time() - began_s
    await gateway.remove_old_recordings()
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


def remount(gateway: Gateway, mode: str) -> None:
    """Mount the file system of the recordings again in the daemon's namespace."""
    inside = ["nsenter", "-t", str(gateway.pid), "-U", "-m", "--preserve-credentials"]
    place = str(gateway.folder / "recordings")
    subprocess.run([*inside, "mount", "-o", f"remount,{mode}", place], check=True)


SCENARIO = Scenario(
    title="disk read-only",
    reported="answer to `record`",
    continues="poses from both sensors",
    counted="nothing, because no recording begins",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=1.0,
    gap_limit_s=0.2,
    kind="host",
    missing=no_namespace,
)
