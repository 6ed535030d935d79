"""The dashboard with the daemon and simulated hardware: calibration with cameras, and its cost.

The cost is the processor time and the memory of the page and of its server. The run writes
screenshots of every view and the measured cost (``cost.json``) to ``build/dashboard``.
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

from jointfit_daemon.outputs.recording import open_recording
from jointfit_daemon.pipeline.events import Request
from tests.broker_fixture import HOST
from tests.system.station import BASE, FIT_PATIENCE_S, Station
from tests.tools.dashboard.browser import PICTURES, SIZES, VIEWS, OpenedPage, chromium, opened

if TYPE_CHECKING:
    from playwright.async_api import Browser

    from jointfit_daemon.tools.child_processes import Simulator
    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(600)]

OPTIONS = (
    *("--follow", "--sensors-hz", "10", "--rate", "50", "--output-rate-hz", "50"),
    *("--align-s", "8", "--static-s", "3", "--functional-s", "25"),
)
"""Options of the simulator: short phases, and slow sensors because the machine may be loaded."""
MEASURED_S = 10.0
"""Duration of the measurement of cost, s."""
ALL_ONLINE = """() => {
  const states = [...jointfit.store.devices.values()].map((device) => device.availability);
  return states.filter((state) => state === 'online').length === 5;
}"""
OPTICAL_PIXELS = """() => {
  const color = getComputedStyle(document.documentElement).getPropertyValue('--optical').trim();
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16));
  const canvas = document.querySelector('#limb');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) {
    const [x, y, z] = [data[i] - r, data[i + 1] - g, data[i + 2] - b];
    if (Math.abs(x) + Math.abs(y) + Math.abs(z) < 24) count += 1;
  }
  return count;
}"""
"""JavaScript that returns the number of pixels in the colour of the cameras."""
TURNED_BY = """([name, degrees]) => {
  const cards = [...document.querySelectorAll('#view-sensors .card')];
  const card = cards.find((card) => card.querySelector('h3')?.textContent === name);
  const text = card?.querySelector('.turn').textContent ?? '';
  const angle = text === 'not turned' ? 0 : Number(/turned (\\d+)°/.exec(text)?.[1] ?? NaN);
  return Math.abs(angle - degrees) <= 5;
}"""
"""JavaScript that returns whether the check of axes shows this rotation, within 5 degrees."""
KNEES = "jointfit.store.poses.map((pose) => pose.joints.knee.flexion_deg).filter((x) => x !== null)"
READY = {
    "live": "difference from the cameras", "calibrate": "Held-out error",
    "history": "Use version 2", "sensors": "Up in the drawing", "table": "Knee flexion",
}  # fmt: skip
"""A text that each view contains when it is complete."""
FIRST_STEPS = ["Align", "Stand still"]
FULL_CURVE = "() => jointfit.store.poses.length > 195"
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
    """Calibrate with cameras by the page's buttons, with a refusal, a stop and a reload."""
    await page.page.click("#main-action")
    await page.page.click(".rail >> text=Move")
    await page.page.click("text=Start moving")
    await page.until_text("#view-calibrate .banner", "needs a static pose first")
    await page.page.click(".rail >> text=Align")
    await page.page.click("text=Start aligning")
    await page.until_text("#rig-state", "Calibrating: turn the plate")
    await page.page.click("text=Stop this step")
    await page.until_text("#view-calibrate", "This step was stopped")

    await page.page.click("text=Try again")
    await page.until_text(".percent", "%")
    await page.page.reload()
    await page.until_text(".step.running .percent", "%")
    await page.until_text(".percent", "6")
    await page.picture("wizard-align")
    await page.until_text("#rig-state", "Sensors aligned", FIT_PATIENCE_S)
    await page.page.wait_for_selector(".step:not(.running) >> text=Start standing")
    await page.picture("wizard-static")
    await page.page.click("text=Start standing")
    await page.until_text("#rig-state", "the movement is next", FIT_PATIENCE_S)

    await page.page.click("text=Start moving")
    await page.until_text(".missing", "of 12 flexions so far")
    await page.until_text(".joints", "± ")
    assert "Predicted errors of the joint centres" in await page.text(".joints")
    assert await page.page.locator(".pose.wanted").count() >= 1
    assert await page.page.locator(".rail .done .rail-title").all_inner_texts() == FIRST_STEPS
    await page.picture("wizard-move")
    assert await page.accessibility_faults() == []
    await page.until_text("#rig-state", "Calibrated, version 1", 60 + FIT_PATIENCE_S)
    await page.until_text("#view-calibrate", "Held-out error against the cameras")
    assert "Knee flexion" in await page.text(".good")
    await page.picture("wizard-result")


async def revert(page: OpenedPage) -> None:
    """Record another static pose, then activate the first calibration in the history."""
    await page.page.click("#menu-button")
    await page.page.click("#menu >> text=Record the static pose again")
    await page.page.click("#action .primary")
    await page.until_text("#rig-state", "Calibrated, version 2", FIT_PATIENCE_S)
    await page.show("history")
    await page.page.click("text=Use version 1")
    await page.until_text("#rig-state", "Calibrated, version 3")
    await page.until_text("#view-history", "in force: copy of version 1")


async def see_the_limb_move(page: OpenedPage) -> None:
    """Wait until the page shows a walking limb, measured by IMUs and by cameras."""
    await page.show("live")
    await page.until_text("#angle-value", "°")
    await page.page.wait_for_selector("#legend-optical", state="visible")
    await page.until_text("#chart-caption", "difference from the cameras")
    await page.page.wait_for_function(f"() => ({OPTICAL_PIXELS})() > 100")
    await page.page.wait_for_function(
        f"() => {{ const x = {KNEES}; return Math.max(...x) - Math.min(...x) > 30; }}"
    )


async def record(page: OpenedPage) -> str:
    """Start, mark and stop a recording in the page; return the name of its file."""
    await page.page.click("text=Start recording")
    await page.until_text("#recording-fact", "0:00:0")
    await page.page.keyboard.press("m")
    await page.until_text("#recording [role=status]", ": mark")
    await page.until_text("#recording", "MB")
    await page.page.reload()
    await page.page.click("text=Stop recording")
    await page.page.click("#action .primary")
    await page.until_text("#action .answer", "nothing lost")
    command = await page.text("#action pre")
    await page.page.click("#action .buttons .button:not(.primary)")
    return command.removeprefix("jointfit report ")


async def turn_a_sensor(page: OpenedPage, simulator: Simulator) -> None:
    """Turn a simulated sensor while the subject stands; its axes on the page must follow."""
    await page.show("sensors")
    await page.until_text("#view-sensors .turn", "turned")
    async with asyncio.timeout(60):
        while True:  # until the subject rests
            await page.page.click("text=Set all to zero")
            await asyncio.sleep(1.0)
            turns = await page.page.locator(".turn").all_inner_texts()
            if set(turns) == {"not turned"}:
                break
    await simulator.send_command("slip S1 90")
    await page.page.wait_for_function(TURNED_BY, arg=["S1", 90], timeout=30_000)
    await page.picture("axes-turned")
    await simulator.send_command("slip S1 -90")
    await page.page.wait_for_function(TURNED_BY, arg=["S1", 0], timeout=30_000)


async def use_the_requests(page: OpenedPage) -> None:
    """Send the requests of the Sensors view; the daemon must answer."""
    await page.page.click("#view-sensors >> text=Self-test")
    await page.until_text("#action .answer", "checks passed")
    await page.picture("self-test")
    await page.page.click("#action .buttons .button:not(.primary)")
    await page.page.click("#view-sensors >> text=Output rate")
    await page.page.fill("#action input", "999")
    await page.page.click("#action .primary")
    await page.until_text("#action .answer", "the sample rate of the fastest sensor")
    await page.page.fill("#action input", "25")
    await page.page.click("#action .primary")
    await page.until_text("#action .answer", "The output rate is 25 Hz; before: 50 Hz.")
    await page.page.click("#action .buttons .button:not(.primary)")
    await page.page.click("#view-sensors >> text=Reload rig.toml")
    await page.page.click("#action .primary")
    await page.until_text("#action .answer", "S1, S2, S3, S4, mocap")
    await page.page.click("#action .buttons .button:not(.primary)")
    await page.page.click('[aria-label="Restart S3"]')
    await page.page.click("#action .primary")
    await page.until_text("#action .answer", "S3 restarts")
    await page.page.click("#action .buttons .button:not(.primary)")
    await page.page.wait_for_function(ALL_ONLINE, timeout=60_000)


async def photograph(browser: Browser, url: str) -> None:
    """Save every view of the calibrated rig, and check that it fits and is accessible."""
    for scheme in ("light", "dark"):
        for size in SIZES:
            async with opened(browser, url, size=size, scheme=scheme) as page:
                await page.until_text("#angle-value", "°")
                for view in VIEWS:
                    await page.show(view)
                    await page.until_text(f"#view-{view}", READY.get(view, ""))
                    await page.picture(f"run-{view}-{size}-{scheme}")
                    overflow = "document.documentElement.scrollWidth - innerWidth"
                    assert await page.page.evaluate(overflow) <= 0, (view, size)
                    assert await page.accessibility_faults() == [], (view, size, scheme)
                assert page.errors == []
                assert page.foreign == []


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
    async with chromium() as browser, station.simulator() as simulator:
        server, url = await start_server(broker)
        try:
            async with opened(browser, url) as page:
                await page.until_text("#empty", "Waiting for jointfitd")
                async with station.daemon() as daemon:
                    await page.until_text("#empty", "Not calibrated yet", 60)
                    await page.page.wait_for_function(ALL_ONLINE, timeout=60_000)
                    await calibrate(page)
                    await see_the_limb_move(page)
                    cost = await measured(browser, page, server)
                    await page.page.wait_for_function(FULL_CURVE, timeout=60_000)
                    await page.picture("run-dashboard")
                    recorded = open_recording(Path(await record(page))).events()
                    commands = [e.command for e in recorded if isinstance(e, Request)]
                    assert commands == ["mark"]
                    await revert(page)
                    await simulator.send_command("play stand")
                    await turn_a_sensor(page, simulator)
                    await use_the_requests(page)
                    await simulator.send_command("play walk")
                    await photograph(browser, url)
                    assert daemon.process is not None
                    daemon.process.send_signal(signal.SIGKILL)
                    await page.until_text("#rig-state", "jointfitd is not running")
                async with station.daemon():
                    await page.until_text("#rig-state", "Calibrated, version 3", 60)
                    await page.show("live")
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
