"""The broker stops reading, but its connections remain open."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tests.faults.scenario import Outcome, Scenario

if TYPE_CHECKING:
    from tests.faults.gateway import Gateway


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text("utf-8")
    return 1024 * int(status.split("VmRSS:")[1].split()[0])


async def run(gateway: Gateway) -> Outcome:
    """Freeze the broker until the daemon detects the loss of the connection."""
    memory = resident_bytes(gateway.pid)
    gateway.broker.freeze()
    try:
        noticed_s = await gateway.disconnected()
        grown = resident_bytes(gateway.pid) - memory
    finally:
        gateway.broker.thaw()
    recovered_s = await gateway.used("S1", "S2")
    assert grown < 16_000_000, f"memory grew by {grown} bytes"
    return Outcome(noticed_s, recovered_s, 0.0, 0)


SCENARIO = Scenario(
    title="broker frozen",
    reported="log; `connects` of the link in `bridge/health`",
    continues="acquisition, fusion and recording; memory grows by less than 16 MB",
    counted="poses of the outage; counter `dropped` of the link",
    run=run,
    noticed_limit_s=8.0,
    recovered_limit_s=1.0,
)
