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


async def main() -> None:
    """Start everything, wait for poses of now, replug a sensor, and stop."""
    with tempfile.TemporaryDirectory() as name:
        broker = chosen_broker()(Path(name))
        broker.start()
        try:
            async with running_gateway(Path(name), broker) as gateway:
                await gateway.fresh_pose()
                outcome = await SCENARIO.run(gateway)
                assert not (faults := SCENARIO.faults(outcome)), faults
                assert "Traceback" not in gateway.log, gateway.log
        finally:
            broker.stop()
    print(f"uptime {time.monotonic():.0f} s: all is well")


asyncio.run(main())
