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
"""Text of a rig.toml with one sensor on one segment. The last table is that of the broker."""

NAMES = {"fake": "FakeImu", "fakecan": "FakeCanImu", "fakemocap": "FakeMocap"}


class FakeSettings(ImuSettings):
    """Settings of a fake IMU on a port; `mood` selects its behaviour."""

    port: str = Field(description="name of the port, never opened")
    mood: str = Field("well", description="well | lost | wrong | bug | hang")


class FakeIds(Settings):
    """Identifiers of a fake IMU on a bus."""

    quaternion: int = Field(0x21, description="id of the quaternion")
    counter: int = Field(0x05, description="id of the counter")


class FakeCanSettings(ImuSettings):
    """Settings of a fake IMU on a bus."""

    can: CanBusSettings = Field(description="its bus")
    ids: FakeIds = Field(default_factory=FakeIds, description="its identifiers")


class FakeMocapSettings(MocapSettings):
    """Settings of a fake mocap server."""

    server: str = Field("127.0.0.1", description="address")


class FakeDecoder:
    """Decoder of a fake IMU: every byte is a sample with the same orientation."""

    tick_clock: TickClock | None = None
    discarded_bytes = 0

    def __init__(self) -> None:
        self.messages = 0

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return one sample for each byte."""
        self.messages += len(chunk.data)
        still = (1.0, 0.0, 0.0, 0.0)
        return [ImuSample(chunk.t_ns, still, still, None, byte) for byte in chunk.data]

    def flush(self) -> list[Decoded]:
        """Return nothing, because no byte is ever pending."""
        return []


class FakeImu:
    """An IMU that sends a counter byte at its rate."""

    Settings: ClassVar[type[Any]] = FakeSettings
    wire: ClassVar[Wire] = "stream"
    running: ClassVar[list[str]] = []
    """Ids of the running devices, in the order of their starts."""
    started: ClassVar[list[str]] = []
    """Ids of all starts."""

    def __init__(self, settings: Any) -> None:
        self._settings = settings

    def decoder(self) -> FakeDecoder:
        """Return a fresh decoder."""
        return FakeDecoder()

    async def run(self, emit: Emit) -> None:
        """Send until cancelled, or fail as `mood` requires."""
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
    """A fake IMU on a bus."""

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
    """Replace importlib.metadata.entry_points."""
    module = "tests.fake_drivers"
    return [EntryPoint(name, f"{module}:{cls}", group) for name, cls in NAMES.items()]


def install(folder: Path) -> None:
    """Write metadata to `folder`, which registers the fake drivers if it is on PYTHONPATH."""
    info = folder / "fake_drivers-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fake-drivers\nVersion: 0\n")
    lines = [f"{name} = tests.fake_drivers:{cls}" for name, cls in NAMES.items()]
    (info / "entry_points.txt").write_text("[jointfit.drivers]\n" + "\n".join(lines) + "\n")
