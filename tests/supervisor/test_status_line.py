"""Readiness and the status line of the service."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.pipeline.events import CalibrationPhase
from jointfit_daemon.supervisor._source_tasks import SourceTasks
from jointfit_daemon.supervisor._status_line import FrameRateCounter, status_line

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk


def source(name: str, kind: str = "imu", driver: Any = None) -> Any:
    return SimpleNamespace(id=name, kind=kind, driver_class=driver, settings=name)


RIG = [source("S1"), source("S2"), source("mocap", "mocap")]
NAN = float("nan")


@pytest.mark.parametrize(
    ("seen", "line"),
    [
        (
            ({"S1", "S2", "mocap"}, CalibrationPhase.CALIBRATED, 49.98, True),
            "2 of 2 IMUs, cameras, calibrated, 50 poses/s",
        ),
        (
            ({"S1"}, CalibrationPhase.UNCALIBRATED, NAN, False),
            "1 of 2 IMUs, missing S2, no cameras, uncalibrated, no broker",
        ),
        (
            ({"S2", "mocap"}, CalibrationPhase.FUNCTIONAL, 0.0, True),
            "1 of 2 IMUs, missing S1, cameras, calibration: functional, 0 poses/s",
        ),
    ],
)
def test_status_line_counts_sensors_and_names_missing_ones(
    seen: tuple[set[str], CalibrationPhase, float, bool], line: str
) -> None:
    online, phase, rate_hz, connected = seen
    assert status_line(RIG, online, phase, rate_hz, connected=connected) == line


def test_status_line_of_a_rig_without_cameras_omits_them() -> None:
    imus = {"S1", "S2"}
    line = status_line(RIG[:2], imus, CalibrationPhase.CALIBRATED, NAN, connected=True)
    assert "cameras" not in line


def test_frame_rate_is_that_since_the_last_call() -> None:
    pace = FrameRateCounter()
    assert pace.rate_hz(7, 100.0) != pace.rate_hz(7, 100.0)  # NaN: no time has passed
    assert pace.rate_hz(507, 110.0) == 50.0
    assert pace.rate_hz(507, 120.0) == 0.0


class StatusLineDriver:
    """A driver that waits for an event, and then sends one byte or ends, depending on its name."""

    def __init__(self, settings: str) -> None:
        self._id = settings

    async def run(self, emit: Any) -> None:
        await GO[self._id].wait()
        if self._id == "lost":
            raise DeviceLostError("away")
        if self._id == "wrong":
            raise DeviceMisconfiguredError("a toaster")
        emit(CHUNK)
        await asyncio.Event().wait()


CHUNK: Chunk = SimpleNamespace(t_ns=1)  # type: ignore[assignment]  # only passed on
GO: dict[str, asyncio.Event] = {}


@pytest.fixture
async def sources() -> Any:
    names = ("well", "lost", "wrong")
    GO.update((name, asyncio.Event()) for name in names)
    async with asyncio.TaskGroup() as tasks:
        made = SourceTasks(tasks, lambda _: None)
        await made.apply([source(name, driver=StatusLineDriver) for name in names])
        yield made
        await made.stop()


async def test_sources_are_known_once_each_sent_a_chunk_or_failed(
    sources: SourceTasks,
) -> None:
    waiting = asyncio.create_task(sources.wait_until_known(10.0))
    for go in GO.values():
        await asyncio.sleep(0.02)
        assert not waiting.done()
        go.set()
    async with asyncio.timeout(1):
        await waiting


async def test_silent_source_is_awaited_for_a_limited_time(sources: SourceTasks) -> None:
    GO["well"].set()
    loop = asyncio.get_running_loop()
    began = loop.time()
    await sources.wait_until_known(0.1)
    assert 0.09 < loop.time() - began < 2.0
