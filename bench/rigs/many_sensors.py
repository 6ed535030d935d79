"""Serial sensors at a constant rate: ``python -m bench.rigs.many_sensors FOLDER NUMBER RATE_HZ``.

The process sends until a line arrives on standard input. It then prints the number of samples that
each sensor sent, as JSON, and answers the host until it is terminated.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from pathlib import Path

from jointfit_simulators.devices import MipDevice

WAKE_S = 0.001
"""Time between two passes over the sensors, s."""
SWING_RAD_S, SWING_RAD = 3.0, 0.5


def sensor_names(number: int) -> list[str]:
    """Return the names of the sensors, which are also the names of their ports."""
    return [f"S{k}" for k in range(1, number + 1)]


async def send_samples(devices: list[MipDevice], rate_hz: float) -> None:
    """Send the due samples of all sensors at every pass until cancelled."""
    number, began_s = 0, time.monotonic()
    while True:
        due = int((time.monotonic() - began_s) * rate_hz)
        while number < due:
            number += 1
            t_s = number / rate_hz
            half = 0.5 * SWING_RAD * math.sin(SWING_RAD_S * t_s)
            for device in devices:
                device.push(round(t_s * 1e9), (math.cos(half), math.sin(half), 0.0, 0.0))
        await asyncio.sleep(WAKE_S)


async def main(folder: str, number: str, rate_hz: str) -> None:
    """Run the sensors."""
    devices = {name: MipDevice(Path(folder) / name) for name in sensor_names(int(number))}
    async with asyncio.TaskGroup() as tasks:
        for device in devices.values():
            tasks.create_task(device.run())
        sending = tasks.create_task(send_samples(list(devices.values()), float(rate_hz)))
        await asyncio.to_thread(sys.stdin.readline)
        sending.cancel()
        print(json.dumps({name: device.sent for name, device in devices.items()}), flush=True)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
