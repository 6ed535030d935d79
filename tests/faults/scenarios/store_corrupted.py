"""The newest stored calibration is damaged."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from tests.faults.scenario import Outcome, Scenario
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


async def run(gateway: Gateway) -> Outcome:
    """Store a version, damage its file, and restart the daemon."""
    rig = load_rig(gateway.rig)
    store = CalibrationStore(gateway.folder / "state" / "calibrations", rig.calibration_store)
    version = store.save(plain_calibration(rig.chain))
    path = store.path(version)
    text = path.read_bytes()
    path.write_bytes(text[: len(text) // 2] + b"\0" * 40)
    await gateway.stop()
    gateway.listener.events.clear()
    recovered_s = await gateway.start()
    noticed_s = await gateway.seconds(lambda: gateway.listener.find_event("faults", path.name))
    assert path.with_name(f"{path.name}.bad").exists()
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="newest stored calibration damaged",
    reported="`bridge/event`, with the file",
    continues="the version before it is used",
    counted="the damaged file is renamed, not deleted",
    run=run,
    noticed_limit_s=1.0,
    recovered_limit_s=20.0,
)
