"""``python -m tests.system.machine_run``: a gateway runs, a sensor is replugged, the daemon stops.

The program runs in the environment of another machine (tests/system/test_other_machines.py).
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from pathlib import Path

from tests.broker_fixture import chosen_broker
from tests.faults.gateway import running_gateway
from tests.faults.scenarios.unplugged_sensor import SCENARIO
from tests.system.station import load_factor


async def main() -> None:
    """Start a gateway, wait for current poses, replug a sensor, and stop the gateway."""
    with tempfile.TemporaryDirectory() as name:
        broker = chosen_broker()(Path(name))
        broker.start()
        try:
            async with running_gateway(Path(name), broker) as gateway:
                await gateway.fresh_pose()
                outcome = await SCENARIO.run(gateway)
                # The claim is only that the daemon runs, so the time limits are doubled.
                assert not (faults := SCENARIO.faults(outcome, 2.0 * load_factor())), faults
                assert "Traceback" not in gateway.log, gateway.log
        finally:
            broker.stop()
    print(f"uptime {time.monotonic():.0f} s: all is well")


asyncio.run(main())
