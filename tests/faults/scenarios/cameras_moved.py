"""The camera software moves to another computer, and the user corrects rig.toml."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from tests.faults.hardware import CameraServer
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Open the server at another port; correct rig.toml and reload."""
    since, cameras, text = (
        len(gateway.listener.poses),
        gateway.cameras,
        gateway.rig.read_text("utf-8"),
    )
    old = cameras.server
    old.unplug()
    noticed_s = await gateway.seconds(lambda: "mocap" not in gateway.listener.online)

    new = CameraServer(replace(old.options, command_port=0))
    serving = asyncio.create_task(new.run())
    cameras.server = new
    ports = (f"command_port = {old.command_port}", f"command_port = {new.command_port}")
    gateway.rig.write_text(text.replace(*ports), "utf-8")
    gateway.reload()
    recovered_s = await gateway.streaming("mocap")

    new.unplug()
    serving.cancel()
    await asyncio.wait([serving])
    cameras.server = old
    old.plug()
    gateway.rig.write_text(text, "utf-8")
    gateway.reload()
    await gateway.streaming("mocap")
    return Outcome(noticed_s, recovered_s, gateway.pose_gap_s(since), 0)


SCENARIO = Scenario(
    title="camera software moved to another address, and rig.toml reloaded",
    reported="`device/mocap/availability`, `bridge/event`",
    continues="poses from the sensors",
    counted="nothing",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=4.0,
    gap_limit_s=0.2,
    kind="all",
)
