"""`jointfit calibrate` with a real daemon reports progress, and the cause of every abort."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.calibrate._report import ProgressLines
from jointfit_daemon.tools.embedded_broker import embedded_broker
from tests.system.station import PATIENCE_S, Station, listening, restore_signals

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.system.station import Listener

STATIC = ("--yes", "--phase", "static", "--seconds", "60")


async def calibrate(rig: Path, *options: str) -> asyncio.subprocess.Process:
    """Start the command with all its output in one pipe."""
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "jointfit_daemon.tools", "calibrate", str(rig), *options),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        preexec_fn=restore_signals,
    )


async def line_with(process: asyncio.subprocess.Process, text: str) -> str:
    """Return the next line of output that contains `text`."""
    assert process.stdout is not None
    async with asyncio.timeout(PATIENCE_S):
        while line := (await process.stdout.readline()).decode():
            if text in line:
                return line
    raise AssertionError(f"ended without {text!r}")


async def rest_of(process: asyncio.subprocess.Process) -> str:
    async with asyncio.timeout(PATIENCE_S):
        output, _ = await process.communicate()
    process._transport.close()  # type: ignore[attr-defined]  # asyncio does not close it
    return output.decode()


@asynccontextmanager
async def walking(folder: Path) -> AsyncIterator[tuple[Path, Listener]]:
    """Yield the rig of a running daemon whose subject never stands still, and a listener."""
    with embedded_broker(folder) as port:
        station = Station(folder, port, options=("--no-mocap", "--programme", "walk"))
        async with station.simulator(), station.daemon(), listening(port) as listener:
            await listener.connected({"S1", "S2", "S3", "S4"})
            yield station.rig, listener


def phase_of(listener: Listener) -> str | None:
    """Return the published phase; None before the first message."""
    phase: str | None = listener.latest.get("calibration", {}).get("phase")
    return phase


@pytest.mark.system
@pytest.mark.timeout(240)
async def test_every_ending_of_the_command_is_reported(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    async with walking(tmp_path) as (rig, listener):
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            with subtests.test(f"{number.name} aborts the phase of the command"):
                await stop_by_signal(rig, listener, number)
        with subtests.test("a closed terminal aborts the phase"):
            await close_the_terminal(rig, listener)
        with subtests.test("a refused request suggests the abort command"):
            await request_twice(rig, listener)


async def stop_by_signal(rig: Path, listener: Listener, number: signal.Signals) -> None:
    process = await calibrate(rig, *STATIC)
    await line_with(process, "static:")
    await listener.until(lambda: phase_of(listener) == "static")
    process.send_signal(number)
    output = await rest_of(process)
    assert process.returncode == 128 + number, output
    assert "static: aborted" in output
    assert f"stopped by {number.name}" in output
    await listener.until(lambda: phase_of(listener) == "aborted")


async def close_the_terminal(rig: Path, listener: Listener) -> None:
    read_end, write_end = os.pipe()
    try:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "jointfit_daemon.tools", "calibrate", str(rig), *STATIC),
            stdin=asyncio.subprocess.DEVNULL,
            stderr=write_end,
        )
        await listener.until(lambda: phase_of(listener) == "static")
    finally:
        os.close(write_end)
        os.close(read_end)
    async with asyncio.timeout(PATIENCE_S):
        assert await process.wait() == 1
    await listener.until(lambda: phase_of(listener) == "aborted")


async def request_twice(rig: Path, listener: Listener) -> None:
    leading = await calibrate(rig, *STATIC)
    await line_with(leading, "static:")
    await line_with(leading, "%")  # progress is also printed without a terminal

    second = await calibrate(rig, *STATIC)
    output = await rest_of(second)
    assert second.returncode == 1
    assert "--abort" in output
    assert phase_of(listener) == "static"  # the phase of another client continues

    ending = await calibrate(rig, "--abort")
    assert "aborted" in await rest_of(ending)
    assert ending.returncode == 0
    assert "static was aborted: abort requested" in await rest_of(leading)
    assert leading.returncode == 1


def test_progress_is_reported_at_the_start_of_a_phase_and_every_five_seconds() -> None:
    lines = ProgressLines()
    found = []
    for tick in range(120):  # 12 s with ten ticks per second
        lines.update("static", tick / 120, "stand still")
        found += lines.due(100.0 + 0.1 * tick, {})
    assert found == ["static: 0 %, stand still", "static: 42 %, stand still",
                     "static: 83 %, stand still"]  # fmt: skip
    lines.update("functional", 0.0, "")
    assert lines.due(112.1, {"joints": {"knee": {"met": False, "source": "markers"}}}) == [
        "functional: 0 %",
        "  … knee: center unknown",
    ]
