"""A simulated x-IMU3 with sensor errors, which moves as `jointfit calibrate sensor` instructs."""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from math import radians
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.inertial_sensor import DIRECTIONS
from jointfit_daemon.model import Chunk
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.ximu3 import DataKind, encode_data
from jointfit_simulators.devices import (
    SensorErrors,
    VectorErrors,
    XImu3Device,
    XImu3DeviceOptions,
)
from jointfit_simulators.devices._inertial_signals import InertialSignals

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

RATE_HZ = 100
PERIOD_NS = 1_000_000_000 // RATE_HZ
SERIAL = "0123ABCD"
GYROSCOPE_BIAS_DEG_S = (1.5, -0.8, 0.4)
GYROSCOPE_SCALE = (1.015, 0.99, 1.005)
ACCELEROMETER_BIAS = (0.4, -0.2, 0.3)
ACCELEROMETER_SCALE = (1.02, 0.98, 1.01)
MAGNETOMETER_BIAS = (0.5, -0.9, 0.3)
ERRORS = SensorErrors(
    VectorErrors(
        (radians(GYROSCOPE_BIAS_DEG_S[0]), radians(-0.8), radians(0.4)),
        ((GYROSCOPE_SCALE[0], 0, 0), (0, GYROSCOPE_SCALE[1], 0), (0, 0, GYROSCOPE_SCALE[2])),
        noise_sd=0.002,
    ),
    VectorErrors(
        ACCELEROMETER_BIAS,
        ((ACCELEROMETER_SCALE[0], 0, 0), (0, ACCELEROMETER_SCALE[1], 0), (0, 0, 1.01)),
        noise_sd=0.02,
    ),
    VectorErrors(MAGNETOMETER_BIAS, ((1.1, 0.05, 0), (0.05, 0.9, 0), (0, 0, 1)), noise_sd=0.004),
)
POSES = DIRECTIONS[[0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 14, 15]]
LEVEL = DIRECTIONS[4]
REST_S, MOVE_S = 1.8, 0.4
RIG = """[rig]
name = "bench"

[chain]
segments = ["thigh", "shank"]
joints = ["hip", "knee", "ankle"]

[[imu]]  # on the thigh
id = "S1"
segment = "thigh"
driver = "ximu3"
port = "{port}"
orientation = "gateway"
magnetometer = true

# the second sensor
[[imu]]
id = "S2"
segment = "shank"
driver = "ximu3"
port = "/dev/ttyUSB7"

[mqtt]
host = "localhost"
"""


def facing(up: np.ndarray) -> Rotation:
    return Rotation.align_vectors([(0.0, 0.0, 1.0)], [up])[0]


def poses_at(seconds: float) -> Rotation:
    """Return the orientation `seconds` after the start of the accelerometer step."""
    number, within = divmod(seconds, REST_S + MOVE_S)
    before, now = (
        facing(POSES[(int(number) + step) % len(POSES)]) if number + step >= 0 else facing(LEVEL)
        for step in (-1, 0)
    )
    left = 0.5 + 0.5 * np.cos(np.pi * min(within / MOVE_S, 1.0))
    return now * Rotation.from_rotvec(left * (now.inv() * before).as_rotvec())


def turned_at(seconds: float) -> Rotation:
    """Return the orientation after `seconds` of the magnetometer step, a turn about all axes."""
    return Rotation.from_euler("zyx", (0.9 * seconds, 2.1 * seconds, 3.3 * seconds))


def movement(step: str, seconds: float) -> Rotation:
    """Return the orientation `seconds` after the instruction of a step."""
    if step == "accelerometer":
        return poses_at(seconds)
    return turned_at(seconds) if step == "magnetometer" else facing(LEVEL)


def recorded_chunks(steps: dict[str, float]) -> Iterator[Chunk]:
    """Yield the chunks that the device sends; `steps` contains the duration of each step, s."""
    signals, t_ns = InertialSignals(ERRORS), 0
    for step, seconds in steps.items():
        for k in range(round(seconds * RATE_HZ)):
            t_ns += PERIOD_NS
            x, y, z, w = movement(step, k / RATE_HZ).as_quat().tolist()
            signals.update(t_ns, (w, x, y, z))
            ticks, data = t_ns // 1000, b""
            if k % 5 == 0:
                field = signals.value(Item.MAGNETIC_FIELD) or ()
                data += encode_data(DataKind.MAGNETIC, ticks, field)
            inertial = (*np.rad2deg(signals.rate), *(np.array(signals.force) / 9.80665))
            data += encode_data(DataKind.INERTIAL, ticks, tuple(map(float, inertial)))
            yield Chunk(t_ns, data)


class MovingHand:
    """Moves a live device; the movement of a step begins at the instruction of the step."""

    def __init__(self, device: XImu3Device) -> None:
        self._device, self._step, self._begin_ns = device, "gyroscope", time.monotonic_ns()

    def follow(self, line: str) -> None:
        """Begin the next movement if `line`, printed by the command, is an instruction."""
        words = {"accelerometer": "six faces", "magnetometer": "in your hand"}
        for step, word in words.items():
            if word in line:
                self._step, self._begin_ns = step, time.monotonic_ns()

    async def run(self) -> None:
        """Send 100 measurements a second until cancelled."""
        while True:
            now_ns = time.monotonic_ns()
            turn = movement(self._step, (now_ns - self._begin_ns) * 1e-9)
            x, y, z, w = turn.as_quat().tolist()
            self._device.push(now_ns, (w, x, y, z))
            await asyncio.sleep(1.0 / RATE_HZ)


@asynccontextmanager
async def held(folder: Path) -> AsyncIterator[MovingHand]:
    """Write rig.toml, run a device, and yield the `MovingHand` that moves the device."""
    (folder / "rig.toml").write_text(RIG.format(port=folder / "imu"), encoding="utf-8")
    stored = {
        "serial_mode": 1, "ahrs_message_rate_divisor": 0, "inertial_message_rate_divisor": 4,
    }  # fmt: skip
    options = XImu3DeviceOptions(settings=stored, errors=ERRORS)
    device = XImu3Device(folder / "imu", options=options)
    hand = MovingHand(device)
    tasks = [asyncio.create_task(work) for work in (device.run(), hand.run())]
    try:
        yield hand
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        device.unplug()
