"""Rotates a simulated sensor as the instructions of the physical test require."""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from scipy.spatial.transform import Rotation, Slerp

from jointfit_simulators.devices import WitMotionDevice, WitMotionDeviceOptions
from jointfit_simulators.devices._witmotion_device import WITH_QUATERNION
from tests.physical_test.turned_sensor import guided_poses

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

TURN_S = 0.4
RIG = """
[rig]
name = "bench"
[chain]
segments = ["thigh", "shank"]
joints = ["hip", "knee", "ankle"]
"""


class Hand:
    """Turns the device to the next pose at each instruction, and holds it at rest there."""

    def __init__(self, device: WitMotionDevice) -> None:
        poses = guided_poses()
        self._poses = [poses[0], *poses]
        self._device, self._step, self._begin_ns = device, 0, 0

    def follow(self, line: str) -> None:
        """Begin the next movement if the line is an instruction."""
        if line.startswith(("Lay ", "Turn it", "Tip it")):
            self._step, self._begin_ns = self._step + 1, time.monotonic_ns()

    async def run(self) -> None:
        """Send 100 orientations a second until cancelled."""
        while True:
            now_ns = time.monotonic_ns()
            share = min((now_ns - self._begin_ns) / 1e9 / TURN_S, 1.0)
            ends = self._poses[max(self._step - 1, 0) : self._step + 1] * (2 - (self._step > 0))
            x, y, z, w = Slerp([0.0, 1.0], Rotation.concatenate(ends[:2]))(share).as_quat().tolist()
            self._device.push(now_ns, (w, x, y, z))
            await asyncio.sleep(0.01)


@asynccontextmanager
async def held(folder: Path, **sent: Any) -> AsyncIterator[Hand]:
    """Run a device with these settings and a rig.toml with default settings; yield the hand."""
    keys = "\n".join(
        f'[[imu]]\nid = "{name}"\nsegment = "{segment}"\ndriver = "witmotion"\nport = "{path}"\n'
        "rate_hz = 100\n"
        for name, segment, path in (
            ("S1", "thigh", folder / "imu"),
            ("S2", "shank", folder / "other"),
        )
    )
    (folder / "rig.toml").write_text(RIG + keys)
    options = WitMotionDeviceOptions(content=WITH_QUATERNION, rate_hz=100, **sent)
    device = WitMotionDevice(folder / "imu", options=options)
    hand = Hand(device)
    tasks = [asyncio.create_task(work) for work in (device.run(), hand.run())]
    try:
        yield hand
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        device.unplug()
