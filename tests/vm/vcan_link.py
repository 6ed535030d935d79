"""Helpers for tests on real SocketCAN: the interface, a running driver, and received frames."""

from __future__ import annotations

import asyncio
import shutil
import socket
import subprocess
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_drivers.xcdi import XcdiSettings
from jointfit_protocols.can import CanFrame, unpack_frames
from jointfit_simulators.wires import PythonCanWire

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.devices import XcdiDevice

LINK = "vcan0"


def has_vcan() -> bool:
    try:
        socket.if_nametoindex(LINK)
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


NEEDS_VCAN = [
    pytest.mark.vm,
    pytest.mark.skipif(
        not has_vcan(), reason=f"no interface {LINK}: run .ci/light_vm.py, or `ip link add {LINK}`"
    ),
]


def ip(*words: str) -> None:
    tool = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    assert tool is not None
    subprocess.run([tool, "link", *words], check=True)


class LinkWire(PythonCanWire):
    """A wire that is unplugged by setting the interface down."""

    def __init__(self) -> None:
        ip("set", LINK, "up")
        super().__init__("socketcan", LINK)

    @override
    def unplug(self) -> None:
        super().unplug()
        ip("set", LINK, "down")

    @override
    def plug(self) -> None:
        ip("set", LINK, "up")
        super().plug()


class RemovableWire(PythonCanWire):
    """A wire that is unplugged by deleting the interface, as with a removed adapter."""

    def __init__(self) -> None:
        super().__init__("socketcan", LINK)

    @override
    def unplug(self) -> None:
        super().unplug()
        if LINK in {name for _, name in socket.if_nameindex()}:
            ip("delete", LINK)

    @override
    def plug(self) -> None:
        if LINK not in {name for _, name in socket.if_nameindex()}:
            ip("add", "dev", LINK, "type", "vcan")
            ip("set", LINK, "up")
        super().plug()


BUS = CanBusSettings(interface="socketcan", channel=LINK, bitrate=1_000_000)


def settings(name: str = "S3", **more: Any) -> XcdiSettings:
    return XcdiSettings(
        id=name, segment="shank", driver="xcdi", can=BUS, **({"silence_s": 0.5} | more)
    )


class ReceivedFrames:
    """Frames that a driver emitted, and the decoded events."""

    def __init__(self, driver: Driver) -> None:
        self.decoder: Any = driver.decoder()
        self.events: list[Any] = []
        self.frames: list[CanFrame] = []

    def emit(self, chunk: Chunk) -> None:
        self.frames += [f for f in unpack_frames(chunk.data) if isinstance(f, CanFrame)]
        self.events += self.decoder.feed(chunk)

    @property
    def samples(self) -> list[ImuSample]:
        return [event for event in self.events if isinstance(event, ImuSample)]

    async def wait_for(self, count: int) -> None:
        async with asyncio.timeout(5):
            while len(self.samples) < count:
                await asyncio.sleep(0.005)


@asynccontextmanager
async def running(driver: Driver) -> AsyncIterator[ReceivedFrames]:
    heard = ReceivedFrames(driver)
    task = asyncio.create_task(driver.run(heard.emit))
    await asyncio.sleep(0.05)
    try:
        yield heard
    finally:
        task.cancel()
        await asyncio.wait({task})
        if not task.cancelled():
            task.result()


def identity(device: XcdiDevice, count: int, first: int = 0) -> None:
    for number in range(first, first + count):
        device.push(number * 10_000_000, (1.0, 0.0, 0.0, 0.0))
