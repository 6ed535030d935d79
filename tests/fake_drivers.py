"""Drivers of devices that do not exist, registered for tests only."""

from __future__ import annotations

import asyncio
import time
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from jointfit_daemon.driver import (
    CanBusSettings,
    DeviceLostError,
    DeviceMisconfiguredError,
    Emit,
    ImuSettings,
    MocapSettings,
    Settings,
    Wire,
)
from jointfit_daemon.model import Chunk, Decoded, ImuSample, TickClock

SMALLEST_RIG = """
[rig]
name = "bench"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "fake"
port = "a"
[mqtt]
host = "127.0.0.1"
port = {port}
"""
"""One sensor on one segment; ends in the table of the broker."""

NAMES = {"fake": "FakeImu", "fakecan": "FakeCanImu", "fakemocap": "FakeMocap"}


class FakeSettings(ImuSettings):
    """A fake IMU on a port; `mood` says how it behaves."""

    port: str = Field(description="name of the port, never opened")
    mood: str = Field("well", description="well | lost | wrong | bug | hang")


class FakeIds(Settings):
    """Identifiers of a fake IMU on a bus."""

    quaternion: int = Field(0x21, description="id of the quaternion")
    counter: int = Field(0x05, description="id of the counter")


class FakeCanSettings(ImuSettings):
    """A fake IMU on a bus."""

    can: CanBusSettings = Field(description="its bus")
    ids: FakeIds = Field(default_factory=FakeIds, description="its identifiers")


class FakeMocapSettings(MocapSettings):
    """A fake mocap server."""

    server: str = Field("127.0.0.1", description="address")


class FakeDecoder:
    """Every byte is one sample that does not move."""

    tick_clock: TickClock | None = None
    discarded_bytes = 0

    def __init__(self) -> None:
        self.messages = 0

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return one sample a byte."""
        self.messages += len(chunk.data)
        still = (1.0, 0.0, 0.0, 0.0)
        return [ImuSample(chunk.t_ns, still, still, None, byte) for byte in chunk.data]

    def flush(self) -> list[Decoded]:
        """Nothing is ever pending."""
        return []


class FakeImu:
    """Sends a counter byte at its rate."""

    Settings: ClassVar[type[Any]] = FakeSettings
    wire: ClassVar[Wire] = "stream"
    running: ClassVar[list[str]] = []
    """Ids that run just now, in the order they started."""
    started: ClassVar[list[str]] = []
    """Ids ever started."""

    def __init__(self, settings: Any) -> None:
        self._settings = settings

    def decoder(self) -> FakeDecoder:
        """Return a fresh decoder."""
        return FakeDecoder()

    async def run(self, emit: Emit) -> None:
        """Behave as the mood says."""
        match getattr(self._settings, "mood", "well"):
            case "lost":
                raise DeviceLostError("nobody is there")
            case "wrong":
                raise DeviceMisconfiguredError("it is a toaster; set mood = well")
            case "bug":
                raise ZeroDivisionError("a bug")
            case "hang":
                hang(Path(self._settings.port))
        self.running.append(self._settings.id)
        self.started.append(self._settings.id)
        count = 0
        try:
            while True:
                count = (count + 1) % 256
                emit(Chunk(time.monotonic_ns(), bytes([count])))
                await asyncio.sleep(1 / self._settings.rate_hz)
        finally:
            self.running.remove(self._settings.id)


def hang(note: Path) -> None:
    """Create `note` and block the event loop."""
    note.touch()
    time.sleep(3600.0)


class FakeCanImu(FakeImu):
    """The same on a bus."""

    Settings: ClassVar[type[Any]] = FakeCanSettings


class FakeMocap:
    """A server that never sends."""

    Settings: ClassVar[type[Any]] = FakeMocapSettings
    wire: ClassVar[Wire] = "datagram"

    def __init__(self, settings: Any) -> None:
        self._settings = settings

    def decoder(self) -> FakeDecoder:
        """Return a fresh decoder."""
        return FakeDecoder()

    async def run(self, emit: Emit) -> None:  # noqa: ARG002 - it never emits
        """Wait until cancelled."""
        await asyncio.Event().wait()


def entry_points(*, group: str) -> list[EntryPoint]:
    """Stand in for importlib.metadata.entry_points."""
    module = "tests.fake_drivers"
    return [EntryPoint(name, f"{module}:{cls}", group) for name, cls in NAMES.items()]


def install(folder: Path) -> None:
    """Make `folder`, put on PYTHONPATH, register the fake drivers in another process."""
    info = folder / "fake_drivers-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fake-drivers\nVersion: 0\n")
    lines = [f"{name} = tests.fake_drivers:{cls}" for name, cls in NAMES.items()]
    (info / "entry_points.txt").write_text("[jointfit.drivers]\n" + "\n".join(lines) + "\n")
