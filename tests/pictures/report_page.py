"""Picture of the report of a simulated session, from the page in Chromium."""

from __future__ import annotations

import asyncio
import io
from typing import TYPE_CHECKING

from PIL import Image

from jointfit_daemon.tools.report.page import render_report
from jointfit_simulators.body import Step
from tests.session_analysis.simulated_session import simulated_session
from tests.tools.dashboard.browser import chromium, opened

if TYPE_CHECKING:
    from pathlib import Path

STEPS = (Step("stand", 5.0), Step("walk", 25.0), Step("squat", 10.0))
HEIGHT = 1540
"""Height of the picture, CSS pixels: to the end of the gait cycles."""


def draw_report(folder: Path, picture: Path) -> None:
    """Write the upper part of a report as WebP."""
    page = folder / "report.html"
    session = simulated_session(STEPS, seed=2, gap_s=(14.0, 16.2))
    page.write_text(render_report(session), encoding="utf-8")
    asyncio.run(_photograph(page, picture))


async def _photograph(page: Path, picture: Path) -> None:
    async with chromium() as browser, opened(browser, page.as_uri()) as shown:
        await shown.page.set_viewport_size({"width": 1048, "height": HEIGHT})
        png = await shown.page.screenshot()
    Image.open(io.BytesIO(png)).save(picture, "WEBP", quality=86, method=6)
