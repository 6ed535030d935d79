"""Plays a recording on virtual devices, and writes a rig.toml for them.

Invariant: the time intervals between the chunks of all sources equal the recorded intervals.
"""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.recorded._recorded_devices import (
    RecordedCameras,
    RecordedCanSource,
    RecordedXbusDevice,
)
from jointfit_simulators.recorded._rig_text import rig_for_devices, toml_text
from jointfit_simulators.recorded._session_file import UnplayableRecordingError
from jointfit_simulators.wires import SlcanAdapter, wait_until_read

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_simulators.recorded._session_file import RecordedSession

    RecordedDevice = RecordedXbusDevice | RecordedCanSource | RecordedCameras

_POLL_S = 0.01
_LEAD_S = 0.2
"""Time between the connection of the last device and the first chunk, s."""
DRIVERS = ("xbus", "xcdi", "natnet")
"""Drivers whose devices can be simulated."""


class RecordedScene:
    """Virtual devices of one recording.

    Parameters
    ----------
    session
        Rig and chunks of the recording.
    directory
        Folder for rig.toml and for the links to the ports.
    broker
        Host and port of the broker in the new rig.toml.

    Raises
    ------
    UnplayableRecordingError
        A device has a driver that cannot be simulated, or the description of the camera server is
        missing.
    """

    def __init__(self, session: RecordedSession, directory: Path, broker: tuple[str, int]) -> None:
        self._directory = directory
        self._devices: dict[str, RecordedDevice] = {}
        self._stopping = asyncio.Event()
        rig, chunks = session.rig, session.chunks
        buses: dict[str, SlcanAdapter] = {}
        ports: dict[str, str] = {}
        bus_ports: dict[str, str] = {}
        for imu in rig["imu"]:
            name, driver, recorded = imu["id"], imu["driver"], chunks.get(imu["id"], [])
            _check_driver(name, driver)
            if driver == "xbus":
                ports[name] = str(directory / f"tty{name}")
                self._devices[name] = RecordedXbusDevice(directory / f"tty{name}", recorded)
            else:
                bus = imu["can"]
                if bus not in buses:
                    link = directory / f"tty{bus}"
                    buses[bus], bus_ports[bus] = SlcanAdapter(link), str(link)
                self._devices[name] = RecordedCanSource(buses[bus], recorded)

        cameras: RecordedCameras | None = None
        if "mocap" in rig and "mocap" in chunks:
            _check_driver("mocap", rig["mocap"]["driver"])
            cameras = self._devices["mocap"] = RecordedCameras(chunks["mocap"])
        self._cameras = cameras
        self._links = [Path(port) for port in (*ports.values(), *bus_ports.values())]
        table = rig_for_devices(
            rig,
            ports=ports,
            buses=bus_ports,
            command_port=None if cameras is None else cameras.command_port,
            broker=broker,
        )
        (directory / "rig.toml").write_text(toml_text(table), encoding="utf-8")

    def stop(self) -> None:
        """End `run`."""
        self._stopping.set()

    def close(self) -> None:
        """Disconnect all devices."""
        for device in self._devices.values():
            device.unplug()

    async def run(self, report: Callable[[dict[str, object]], None]) -> None:
        """Send the recording once after all devices are connected; report start and end."""
        serving = [
            asyncio.create_task(device.run(), name=f"device {name}")
            for name, device in self._devices.items()
        ]
        report(
            {
                "ready": True,
                "rig": str(self._directory / "rig.toml"),
                "devices": list(self._devices),
            }
        )
        playing = asyncio.create_task(self._play(report), name="recording")
        stopping = asyncio.create_task(self._stopping.wait(), name="stop")
        try:
            await asyncio.wait([playing, stopping], return_when=asyncio.FIRST_COMPLETED)
            if playing.done():
                playing.result()
        finally:
            for task in (*serving, playing, stopping):
                task.cancel()
            await asyncio.wait([*serving, playing, stopping])
            self.close()
        report({"sent": {name: device.sent for name, device in self._devices.items()}})

    async def _play(self, report: Callable[[dict[str, object]], None]) -> None:
        active = {name: device for name, device in self._devices.items() if device.chunks}
        while not all(device.ready for device in active.values()):  # noqa: ASYNC110 - several hosts
            await asyncio.sleep(_POLL_S)
        begin_ns = time.monotonic_ns() + round(_LEAD_S * NS_PER_S)
        if self._cameras is not None:
            self._cameras.begin(begin_ns)

        order = sorted(
            (t_ns, name, data) for name, device in active.items() for t_ns, data in device.chunks
        )
        first_ns = order[0][0]  # the first chunk after the omitted handshake
        report({"playing": round((order[-1][0] - first_ns) / NS_PER_S, 3)})
        for t_ns, name, data in order:
            due_ns = begin_ns + t_ns - first_ns
            ahead_ns = due_ns - time.monotonic_ns()
            if ahead_ns > 0:
                await asyncio.sleep(ahead_ns / NS_PER_S)
            active[name].send(data)
        await wait_until_read(self._links)


def _check_driver(name: str, driver: str) -> None:
    if driver not in DRIVERS:
        raise UnplayableRecordingError(
            f"{name}: no simulated device for driver {driver!r}; known: {', '.join(DRIVERS)}. Use "
            "`jointfit replay` instead"
        )
