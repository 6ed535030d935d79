"""A rig with a fault at almost every source: the daemon reports each fault with its remedy."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import itertools
import math
import os
import time
from bisect import bisect
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.child_processes import daemon
from jointfit_protocols.xcdi import XcdiIds
from jointfit_simulators.devices import (
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    XbusDevice,
    XbusDeviceOptions,
    XcdiDevice,
    XcdiDeviceOptions,
)
from jointfit_simulators.wires import PtyLine, SlcanAdapter
from tests.system.station import (
    BASE,
    PATIENCE_S,
    Listener,
    knee_angles,
    listening,
    load_factor,
    sensors_in,
    store_calibration,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

PERIOD_NS = 10_000_000
NMEA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
MODEM = b"AT+CGMI\r\r\nERROR\r\n"
"""Bytes of a device that answers a command of ModemManager: the repeated command, and an error."""
MODEM_EVERY = 40
"""Number of messages of the device between two commands of ModemManager."""
SERVED_US, STALL_US = 200_000, 20_000
"""Conditions for the check of a pose, us. The simulated devices must have sent without a pause
longer than `STALL_US`, from `SERVED_US` before the pose to `SERVED_US` after it. On a loaded
machine, this process may stop sending, and poses without sensors are then correct."""
APPEARS_S = 2.0
"""Limit from the appearance of a port to the availability of its device, s."""
SHARED = XcdiIds(0x105, 0x106, 0x121, status_word=None, error=None)
MARKERS = ("T1", "T2", "T3", "C1", "C2", "C3")

RIG = """
[rig]
name = "faulty"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
{imus}
[can.can0]
interface = "slcan"
channel = "{folder}/can"
[[imu]]
id = "twin"
segment = "thigh"
driver = "xcdi"
can = "can0"
ids = {{ sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }}
[[imu]]
id = "mute"
segment = "shank"
driver = "xcdi"
can = "can0"
ids = {{ sample_time = 0x305, group_counter = 0x306, quaternion = 0x321 }}
[mocap]
driver = "natnet"
server = "127.0.0.1"
command_port = {mocap}
markers.thigh = ["T1", "T2", "Thigh3"]
markers.shank = ["C1", "C2", "C3"]
[mqtt]
host = "127.0.0.1"
port = {mqtt}
base = "{base}"
health_s = 0.5
"""
IMU = """
[[imu]]
id = "{name}"
segment = "{segment}"
driver = "xbus"
port = "{folder}/{name}"
baud = 921600
"""


def _modem_noise() -> Callable[[bytes], bytes]:
    numbers = itertools.count(1)

    def noise(message: bytes) -> bytes:
        return MODEM + message if next(numbers) % MODEM_EVERY == 0 else message

    return noise


@dataclass
class FaultyHardware:
    """Devices at the daemon's ports; only `good` and `modem` agree with the rig.toml."""

    folder: Path
    server: NatNetServer = field(init=False)

    def __post_init__(self) -> None:
        self.good = XbusDevice(self.folder / "good")
        self.modem = XbusDevice(self.folder / "modem", wire_noise=_modem_noise())
        self.slow = XbusDevice(
            self.folder / "slow", options=XbusDeviceOptions(baud=115_200, measures_at_once=True)
        )
        self.gps, self.taken = PtyLine(self.folder / "gps"), PtyLine(self.folder / "taken")
        self.bus = SlcanAdapter(self.folder / "can")
        self.twins = [
            XcdiDevice(self.bus, XcdiDeviceOptions(SHARED, first_counter=n, first_tick=n))
            for n in (0, 31_000)
        ]
        bodies = (RigidBodyAsset("Thigh", MARKERS[:3], 1), RigidBodyAsset("Shank", MARKERS[3:], 2))
        self.server = NatNetServer(NatNetServerOptions(bodies=bodies))
        self.absent: XbusDevice | None = None
        self.pushed_us: list[int] = []
        """UNIX time of each push, us."""
        self.refused = 0
        """Number of messages of `modem` that its full line refused, because a paused daemon had not
        read."""

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for device in (self.good, self.modem, self.slow, self.bus, self.server):
                tasks.create_task(device.run())
            tasks.create_task(self._play())

            while self.absent is None:
                await asyncio.sleep(0.01)
            tasks.create_task(self.absent.run())

    async def _play(self) -> None:
        number, began_ns = 0, time.monotonic_ns()
        while True:
            number += 1
            t_ns = began_ns + number * PERIOD_NS  # a sensor samples on time, whatever the load
            await asyncio.sleep(max(0.0, (t_ns - time.monotonic_ns()) / 1e9))
            self._push(t_ns, 0.4 * math.sin(0.03 * number), number)

    def _push(self, t_ns: int, half: float, number: int) -> None:
        """Send one sample of each device: the thigh rests apart from noise, the shank turns."""
        self.pushed_us.append(time.time_ns() // 1000)
        noise = 1e-4 * math.sin(number)  # without noise the sensors would be reported as stuck
        rest = (math.cos(noise), math.sin(noise), 0.0, 0.0)
        turned = (math.cos(half), 0.0, math.sin(half), 0.0)
        resting: list[XbusDevice | XcdiDevice] = [self.good, self.slow, *self.twins]
        for sensor in resting:
            sensor.push(t_ns, rest)
        sent, streaming = self.modem.sent, self.modem.streaming
        for device in (self.modem, self.absent):
            if device is not None:
                device.push(t_ns, turned)
        self.refused += streaming and self.modem.sent == sent
        if number % 20 == 0:
            self.gps.write(NMEA)
        self.server.push(t_ns, dict.fromkeys(MARKERS, (0.1, 0.2, 0.3)), {})

    def served(self, pose: dict[str, Any]) -> bool:
        """Return whether samples were pushed without a stall before and after a pose."""
        t_us: int = pose["t_us"]
        first, last = t_us - SERVED_US, t_us + SERVED_US
        pushed = self.pushed_us
        near = pushed[bisect(pushed, first) : bisect(pushed, last)]
        return max(b - a for a, b in itertools.pairwise([first, *near, last])) < STALL_US

    def close(self) -> None:
        for device in (self.good, self.modem, self.slow, self.gps, self.taken, self.bus):
            device.unplug()
        if self.absent is not None:
            self.absent.unplug()
        self.server.unplug()


@contextlib.asynccontextmanager
async def plugged_in(folder: Path) -> AsyncIterator[FaultyHardware]:
    hardware = FaultyHardware(folder)
    running = asyncio.create_task(hardware.run(), name="hardware")
    held = os.open(folder / "taken", os.O_RDWR | os.O_NOCTTY)
    fcntl.flock(held, fcntl.LOCK_EX)  # like another program
    try:
        yield hardware
    finally:
        running.cancel()
        await asyncio.wait([running])
        os.close(held)
        hardware.close()


def write_rig(folder: Path, mqtt: int, mocap: int) -> Path:
    names = {"good": "thigh", "modem": "shank", "slow": "thigh", "gps": "shank"}
    names |= {"taken": "thigh", "absent": "shank"}
    imus = "".join(IMU.format(name=n, segment=s, folder=folder) for n, s in names.items())
    text = RIG.format(imus=imus, folder=folder, mocap=mocap, mqtt=mqtt, base=BASE)
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return folder / "rig.toml"


EXPECTED = {
    "slow": ("921600 baud, but no message can be decoded", "set baud = 115200"),
    "gps": ("is not Xbus", "correct `port` or `driver`"),
    "taken": ("is used by another program", "fuser", "ModemManager", "udev rule"),
    "absent": ("is not there", "plug it in, or set `port`"),
    "modem": ("bytes discarded: ",),
    "twin": ("two sensors use the same CAN identifiers", "set `ids`"),
    "mute": ("no quaternion (0x321) arrives", "check its power and wiring, and `ids`"),
    "mocap": ("marker 'Thigh3' (mocap.markers.thigh) is not in the stream", "The server has", "T3"),
}


@pytest.mark.timeout(180)
async def test_each_faulty_source_is_reported_with_a_remedy_while_the_others_work(
    tmp_path: Path, broker: Broker
) -> None:
    async with plugged_in(tmp_path) as hardware, listening(broker.port) as listener:
        rig = write_rig(tmp_path, broker.port, hardware.server.command_port)
        store_calibration(rig, tmp_path / "state")
        async with daemon(tmp_path, rig) as child:
            for name, parts in EXPECTED.items():
                await listener.event(name, *parts)

            poses = await served_poses(hardware, listener, 100)
            lacking = [pose for pose in poses if not {"good", "modem"} <= sensors_in(pose)]
            assert not lacking, lacking[-1]
            assert not {"slow", "gps", "taken", "mute"} & sensors_in(poses[-1])
            angles = knee_angles(poses)
            assert len(angles) == len(poses)
            assert max(angles) - min(angles) > 5

            await plug_absent(hardware, listener)
            devices = await listener.health(
                lambda d: d["modem"]["received"] > 3 * MODEM_EVERY and d["twin"]["corrupt"] > 20
            )
            assert devices["modem"]["corrupt"] >= 3
            assert devices["modem"]["lost"] <= hardware.refused
            assert devices["twin"]["received"] < 20
            await listener.connected({"good", "modem", "mocap"})
            assert not {"slow", "gps", "taken", "mute"} & listener.online
            child.check()


async def served_poses(
    hardware: FaultyHardware, listener: Listener, count: int
) -> list[dict[str, Any]]:
    """Return further poses around which the devices sent their samples without a pause."""
    began, found = len(listener.poses), list[dict[str, Any]]()
    async with asyncio.timeout(PATIENCE_S):
        while len(found) < count:
            await listener.more_poses(count)
            await asyncio.sleep(SERVED_US / 1e6)
            found = [pose for pose in listener.poses[began:] if hardware.served(pose)]
    return found


async def plug_absent(hardware: FaultyHardware, listener: Listener) -> None:
    """Create the missing port and check that its device is used within `APPEARS_S`."""
    hardware.absent = XbusDevice(hardware.folder / "absent")
    await listener.connected({"absent"}, APPEARS_S * load_factor())
    await listener.until(lambda: "absent" in sensors_in(listener.poses[-1]))
    pose = (await served_poses(hardware, listener, 1))[0]
    assert {"good", "modem"} <= sensors_in(pose)
