"""Costs of the dashboard: CPU time and memory with viewers, first paint, and frame times.

Invariant: server, viewers, daemon and browser are separate processes. Rounds with and without
viewers alternate, so a change of the machine's load does not appear as a cost.
"""

from __future__ import annotations

import asyncio
import sys
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.rigs.gateway import Load, cpu_s, rss_mb, running_gateway
from tests.tools.dashboard.browser import chromium, opened
from tests.tools.dashboard.published_rig import PublishedRig, publishing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import Browser

ROOT = Path(__file__).resolve().parents[2]
HOST = "127.0.0.1"
COUNTS = (0, 1, 10)
"""Numbers of viewers in successive rounds."""
JOIN_S, WARM_S = 30.0, 1.0
"""Time limit for the connection of viewers, and time in which the page draws its first curves, s.
"""
_TRANSFER = """() => [
  performance.getEntriesByType('resource').concat(performance.getEntriesByType('navigation'))
    .reduce((sum, entry) => sum + entry.transferSize, 0),
  performance.getEntriesByName('first-contentful-paint')[0].startTime,
]"""


@dataclass(slots=True)
class ViewerCosts:
    """CPU share in each round, %, and memory of the server, MB, by number of viewers."""

    daemon_pct: dict[int, list[float]] = field(default_factory=lambda: {n: [] for n in COUNTS})
    server_pct: dict[int, list[float]] = field(default_factory=lambda: {n: [] for n in COUNTS})
    server_mb: dict[int, float] = field(default_factory=dict)
    kilobytes_s: float = 0.0
    """Data rate to each viewer, kB/s."""


@dataclass(slots=True)
class PageCosts:
    """Costs of the page in a browser."""

    transferred_kb: float
    paint_ms: list[float]
    """Time of the first contentful paint of a page in a new window, ms."""
    limb_ms: list[float]
    """Main-thread time of each drawing of the limb, ms."""
    curve_ms: list[float]
    """Main-thread time of each drawing of the curve, ms."""
    seconds: float
    """Time in which the limb and the curve were drawn, s."""


@asynccontextmanager
async def dashboard_server(port: int) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """Run `jointfit dashboard` with a broker; yield the process and the URL of the page."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "jointfit_daemon.tools.__main__", "dashboard",
        "--listen", f"{HOST}:0", "--broker", f"mqtt://{HOST}:{port}",
        stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        yield process, (await process.stdout.readline()).decode().split()[1]
    finally:
        process.terminate()
        await process.communicate()


async def measure_viewers(folder: Path, port: int, rounds: int, seconds: float) -> ViewerCosts:
    """Return the cost of viewers for a daemon with four IMUs at 100 Hz and cameras."""
    found = ViewerCosts()
    base = f"jointfit/{folder.name}"
    async with (
        running_gateway(folder, port, Load(100.0)) as gateway,
        dashboard_server(port) as (server, url),
    ):
        page_port = int(url.rstrip("/").rpartition(":")[2])
        for _ in range(rounds):
            for count in COUNTS:
                async with _viewers(page_port, base, count, found):
                    daemon, own, began = cpu_s(gateway.pid), cpu_s(server.pid), time.monotonic()
                    await asyncio.sleep(seconds)
                    share = 100.0 / (time.monotonic() - began)
                    found.daemon_pct[count].append(share * (cpu_s(gateway.pid) - daemon))
                    found.server_pct[count].append(share * (cpu_s(server.pid) - own))
                    found.server_mb[count] = rss_mb(server.pid)
    return found


@asynccontextmanager
async def _viewers(port: int, base: str, count: int, found: ViewerCosts) -> AsyncIterator[None]:
    """Run viewers in another process during the ``async with`` block."""
    if count == 0:
        yield
        return
    words = ("-m", "bench.rigs.dashboard_viewers", str(port), base, str(count))
    process = await asyncio.create_subprocess_exec(
        sys.executable, *words, cwd=ROOT,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    async with asyncio.timeout(JOIN_S):
        await process.stdout.readline()
    began = time.monotonic()
    try:
        yield
    finally:
        took_s = time.monotonic() - began
        received, _ = await process.communicate(b"")
        found.kilobytes_s = int(received) / took_s / 1000


async def measure_page(port: int, windows: int, seconds: float) -> PageCosts:
    """Return the cost of the page for a rig that publishes ten poses per second."""
    async with (
        chromium() as browser,
        publishing(PublishedRig(), port),
        dashboard_server(port) as (_, url),
    ):
        loads = [await _load(browser, url) for _ in range(windows)]
        async with opened(browser, url) as page:
            await page.until_text("#angle-value", "°")
            await asyncio.sleep(WARM_S)
            await page.page.evaluate(
                "jointfit.limb.frames.length = jointfit.angle.frames.length = 0"
            )
            began = time.monotonic()
            await asyncio.sleep(seconds)
            limb, curve = await page.page.evaluate("[jointfit.limb.frames, jointfit.angle.frames]")
            took_s = time.monotonic() - began
    transferred_kb = max(transfer for transfer, _ in loads) / 1000
    return PageCosts(transferred_kb, [paint for _, paint in loads], limb, curve, took_s)


async def _load(browser: Browser, url: str) -> tuple[float, float]:
    """Return the bytes that a new window receives, and the time of its first paint, ms."""
    async with opened(browser, url) as page:
        await page.until_text("#angle-value", "°")
        await asyncio.sleep(WARM_S)
        transferred, paint_ms = await page.page.evaluate(_TRANSFER)
    return transferred, paint_ms
