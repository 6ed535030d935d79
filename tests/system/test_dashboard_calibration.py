"""The dashboard with the daemon and simulated hardware: calibration through the page, and its cost.

The run writes the measured cost to ``build/dashboard/cost.json``.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.broker_fixture import HOST
from tests.system.station import BASE, FIT_PATIENCE_S, Station
from tests.tools.dashboard.browser import PICTURES, OpenedPage, chromium, opened

if TYPE_CHECKING:
    from playwright.async_api import Browser

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(400)]

SHORT = (("static_s = 5", "static_s = 3"),)
"""Duration of the static phase, s."""
OPTIONS = ("--follow", "--no-mocap", "--sensors-hz", "10", "--rate", "50", "--output-rate-hz", "50")
"""Options of the simulator: IMUs only, because the fits of a functional phase take minutes beside
a browser on a loaded machine."""
MEASURED_S = 10.0
"""Duration of the measurement of cost, s."""
ALL_ONLINE = """() => {
  const states = [...jointfit.store.devices.values()].map((device) => device.availability);
  return states.filter((state) => state === 'online').length === 4;
}"""
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


async def start_server(broker: Broker) -> tuple[asyncio.subprocess.Process, str]:
    """Start `jointfit dashboard` as a process; return it and the URL of its page."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "jointfit_daemon.tools.__main__", "dashboard",
        "--listen", f"{HOST}:0", "--broker", f"mqtt://{HOST}:{broker.port}", "--base", BASE,
        stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    line = (await process.stdout.readline()).decode()
    return process, line.split()[1]


def cpu_s(process: asyncio.subprocess.Process) -> float:
    """Return the CPU time of a process, s."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def memory_mb(process: asyncio.subprocess.Process) -> float:
    """Return the resident memory of a process, MB."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


async def calibrate(page: OpenedPage) -> None:
    """Calibrate by the buttons of the page."""
    await page.page.click("#main-action")
    await page.page.click("text=Start standing")
    await page.until_text("#rig-state", "Calibrated, version 1", FIT_PATIENCE_S)
    await page.until_text("#view-calibrate", "Static pose, still for")
    await page.picture("calibration")
    assert await page.accessibility_faults() == []


async def measured(
    browser: Browser, page: OpenedPage, server: asyncio.subprocess.Process
) -> dict[str, Any]:
    """Return the cost of the page and of its server."""
    await page.show("live")
    before = cpu_s(server)
    await page.page.evaluate("jointfit.limb.frames.length = jointfit.angle.frames.length = 0")
    await asyncio.sleep(MEASURED_S)
    server_pct = 100.0 * (cpu_s(server) - before) / MEASURED_S
    frames = await page.page.evaluate("[jointfit.limb.frames, jointfit.angle.frames]")
    async with opened(browser, page.origin) as fresh:
        await fresh.until_text("#angle-value", "°")
        await asyncio.sleep(1.0)
        transfer, paint_ms = await fresh.page.evaluate(
            """() => [
              performance.getEntriesByType('resource').concat(performance.getEntriesByType('navigation'))
                .reduce((sum, entry) => sum + entry.transferSize, 0),
              performance.getEntriesByName('first-contentful-paint')[0]?.startTime,
            ]"""
        )
    drawing, curve = (sorted(times) for times in frames)
    return {
        "transferred_kb": transfer / 1000,
        "first_paint_ms": paint_ms,
        "limb_frames_per_s": len(drawing) / MEASURED_S,
        "limb_frame_median_ms": drawing[len(drawing) // 2],
        "limb_frame_p95_ms": drawing[int(0.95 * len(drawing))],
        "curve_update_median_ms": curve[len(curve) // 2],
        "server_cpu_pct": server_pct,
        "server_memory_mb": memory_mb(server),
    }


async def test_a_rig_is_calibrated_in_the_page_and_survives_daemon_and_broker(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, OPTIONS)
    async with chromium() as browser, station.simulator(*SHORT):
        server, url = await start_server(broker)
        try:
            async with opened(browser, url) as page:
                await page.until_text("#empty", "Waiting for jointfitd")
                async with station.daemon() as daemon:
                    await page.until_text("#empty", "Not calibrated yet", 60)
                    await page.page.wait_for_function(ALL_ONLINE, timeout=60_000)
                    await calibrate(page)
                    await page.show("live")
                    await page.until_text("#angle-value", "°")
                    await page.until_text("#chart-caption", "Last 20 s")
                    await page.picture("calibrated")
                    cost = await measured(browser, page, server)
                    await page.show("sensors")
                    await page.until_text("#view-sensors", "Turn one sensor by hand")
                    await page.picture("axes")
                    await page.show("live")
                    assert daemon.process is not None
                    daemon.process.send_signal(signal.SIGKILL)
                    await page.until_text("#rig-state", "jointfitd is not running")
                async with station.daemon():
                    await page.until_text("#rig-state", "Calibrated, version 1", 60)
                    await page.until_text("#angle-value", "°", 60)
                    broker.stop()
                    await page.until_text("#banner", "start the broker")
                    broker.start()
                    await page.until_text("#angle-value", "°", 60)
                assert page.errors == []
                assert page.foreign == []
        finally:
            server.terminate()
            await server.communicate()
    (PICTURES / "cost.json").write_text(json.dumps(cost, indent=1))
    assert cost["transferred_kb"] <= 300
    assert cost["server_memory_mb"] <= 40
    assert cost["limb_frame_median_ms"] <= 5
