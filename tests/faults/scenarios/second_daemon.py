"""A second daemon uses the same port."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.tools.child_processes import daemon
from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Start a second daemon on the rig of the first one, with a state directory of its own."""
    since, folder = len(gateway.listener.poses), gateway.folder / "second"
    folder.mkdir(exist_ok=True)
    before = (await gateway.health())["devices"]["S1"]
    rig = folder / "rig.toml"
    text = gateway.rig.read_text("utf-8").replace("jointfit/faults", "jointfit/second")
    rig.write_text(text.replace(f"{gateway.folder}/recordings", f"{folder}/recordings"), "utf-8")

    def log() -> str:
        return (folder / "daemon.log").read_text("utf-8", "replace")

    async with daemon(folder, rig):
        noticed_s = await gateway.seconds(lambda: "is used by another program" in log())
    recovered_s = await gateway.used("S1", "S2")
    after = (await gateway.health())["devices"]["S1"]
    return Outcome(
        noticed_s,
        recovered_s,
        gateway.pose_gap_s(since),
        after["reconnects"] - before["reconnects"],
    )


SCENARIO = Scenario(
    title="second daemon on the same port",
    reported="log of the second daemon",
    continues="everything in the first daemon",
    counted="nothing; the figure is `reconnects` of the device in the first daemon",
    run=run,
    noticed_limit_s=20.0,
    recovered_limit_s=0.5,
    gap_limit_s=0.3,
)
