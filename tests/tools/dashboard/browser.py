"""Debian's Chromium under Playwright, for tests of the dashboard's page."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import Browser, Page

ROOT = Path(__file__).resolve().parents[3]
PICTURES = ROOT / "build" / "dashboard"
"""Folder of the screenshots."""
ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
SIZES = {"phone": (375, 812), "tablet": (768, 1024), "desktop": (1440, 900)}
"""Names and sizes of windows, CSS pixels."""
VIEWS = ("live", "calibrate", "history", "sensors", "log", "table")
SERIOUS = {"serious", "critical"}
"""Impact levels of axe-core findings that make a test fail."""


@dataclass
class OpenedPage:
    """A page, the requests it sent, and the errors it reported."""

    page: Page
    origin: str
    requests: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    @property
    def foreign(self) -> list[str]:
        """Requests to another origin than that of the page."""
        own = urlsplit(self.origin).netloc
        return [url for url in self.requests if urlsplit(url).netloc != own]

    async def text(self, selector: str) -> str:
        return (await self.page.text_content(selector) or "").strip()

    async def until_text(self, selector: str, part: str, within_s: float = 30.0) -> None:
        """Wait until an element contains a text."""
        await self.page.wait_for_function(
            "([selector, part]) => document.querySelector(selector)?.textContent.includes(part)",
            arg=[selector, part], timeout=within_s * 1000,
        )  # fmt: skip

    async def show(self, view: str) -> None:
        await self.page.click(f"#tab-{view}")

    async def picture(self, name: str) -> None:
        PICTURES.mkdir(parents=True, exist_ok=True)
        await self.page.screenshot(path=PICTURES / f"{name}.png", full_page=True)

    async def accessibility_faults(self) -> list[str]:
        """Return the serious findings of axe-core in the present view."""
        from axe_playwright_python.base import AXE_SCRIPT  # noqa: PLC0415 - optional

        if not await self.page.evaluate("typeof axe !== 'undefined'"):
            await self.page.evaluate(AXE_SCRIPT)
        found: dict[str, Any] = await self.page.evaluate("axe.run()")
        return [
            f"{fault['id']}: {node['html'][:160]}: {node['failureSummary']}"
            for fault in found["violations"]
            if fault["impact"] in SERIOUS
            for node in fault["nodes"]
        ]


@contextlib.asynccontextmanager
async def chromium() -> AsyncIterator[Browser]:
    """Yield a browser; skip the test if Chromium or Playwright is not installed."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("chromium is not installed (Debian: apt install chromium)")
    if find_spec("playwright") is None or find_spec("axe_playwright_python") is None:
        pytest.skip("playwright is not installed (pip install --group browser)")
    from playwright.async_api import async_playwright  # noqa: PLC0415 - optional

    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            await browser.close()


@contextlib.asynccontextmanager
async def opened(
    browser: Browser, url: str, *, size: str = "desktop", scheme: str = "light"
) -> AsyncIterator[OpenedPage]:
    """Yield the page in a new window."""
    width, height = SIZES[size]
    context = await browser.new_context(
        viewport={"width": width, "height": height},
        color_scheme="dark" if scheme == "dark" else "light",
        device_scale_factor=1,
    )
    page = await context.new_page()
    found = OpenedPage(page, url)
    page.on("request", lambda request: found.requests.append(request.url))
    page.on("websocket", lambda websocket: found.requests.append(websocket.url))
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    try:
        await page.goto(url)
        yield found
    finally:
        await context.close()
