"""The run of the tutorial: its commands as printed, pictures of terminals and of the dashboard.

The commands are those of docs/tutorial.md; the phases of the calibration have their real length.
"""

from __future__ import annotations

import asyncio
import io
import re
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST, chosen_broker
from tests.documented_commands import Block, Shell, page_parts
from tests.pictures import moving_limb, terminal
from tests.test_docs_commands import environment, shorten_simulations
from tests.tools.dashboard.browser import OpenedPage, chromium, opened

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.broker_fixture import Broker

ROOT = Path(__file__).resolve().parents[2]
BASE = "jointfit/demo"
QUALITY = 82
"""Quality of the WebP pictures."""
WALK_S = 20.0
"""Time for which the subject walks before the last pictures, s: the duration of the curve."""
CLOCKS_S = 8.0
"""Time for the clocks of the sensors to settle, s."""
MARKED_S = 4.0
"""Time between two marks, s."""
MARGIN_PX = 16.0
"""Margin below the recording in its picture."""
START_S = 6.0
"""Time from the end of the calibration until the simulated subject walks, s."""
MOST_LINES = 16
SHOW_BROKER = """(address) => {
  const shown = document.querySelector("#broker-text");
  const copy = shown.cloneNode();
  copy.removeAttribute("id");
  copy.textContent = address;
  shown.after(copy);
  shown.hidden = true;
}"""
TERMINALS = {
    "jointfitd --version": ("install", "jointfitd prints its version"),
    "jointfit-sim play": ("simulator", "The simulator prints the addresses of its ports"),
    "jointfit check": ("check", "Table of the sensors S1 to S4 and the cameras"),
    "jointfitd --config": (
        "daemon",
        "The daemon connects to the broker; its sources are streaming",
    ),
    "jointfit calibrate": (
        "calibrate",
        "The calibration is stored, with errors of segments and knee",
    ),
    "head": ("export", "Rows of the CSV file with time and knee angles"),
}
"""Name and description of each picture, by the begin of the command that it shows."""


class TutorialRun:
    """Runs the commands of the tutorial in a folder and writes its pictures to `pictures`."""

    def __init__(self, folder: Path, broker: Broker, pictures: Path) -> None:
        self._broker, self._pictures = broker, pictures
        self._home, self._reader, self._logs = (folder / n for n in ("home", "jointfitd", "logs"))
        for made in (self._home, self._reader, self._logs):
            made.mkdir()
        (self._reader / "examples").symlink_to(ROOT / "examples")
        shorten_simulations(broker, self._home, phases="")
        text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
        blocks = (part for part in page_parts(text) if isinstance(part, Block))
        self._commands = [command for block in blocks for command in block.commands]

    def _command(self, begin: str) -> str:
        return next(command for command in self._commands if command.startswith(begin))

    async def run(self) -> None:
        """Run the tutorial with a browser beside it."""
        with Shell(self._reader, environment(self._home), self._logs) as shell:
            for begin in ("jointfitd --version", "jointfit-sim play", "jointfit check"):
                await self._terminal(shell, begin)
            await self._terminal(shell, "jointfitd --config")
            await self._dashboard("uncalibrated", "#empty", "Not calibrated yet", CLOCKS_S)
            # the browser is closed, because it takes processor time from the simulated devices
            await self._terminal(shell, "jointfit calibrate")
            await self._walk()
            await self._dashboard("live", "#angle-value", "°", WALK_S)
            async with self._page() as page:
                self._write("recording.webp", webp(await recording_picture(page)))
            await asyncio.to_thread(shell.run, self._command("python examples"))
            await self._terminal(shell, "head", before="python examples")
            shell.stop_services()

    async def _dashboard(self, name: str, selector: str, words: str, wait_s: float) -> None:
        """Take a picture of the dashboard, some time after an element contains the words."""
        async with self._page() as page:
            await page.until_text(selector, words, 60)
            await asyncio.sleep(wait_s)
            await page.page.evaluate(SHOW_BROKER, "127.0.0.1:1883")  # default port
            png = await page.page.screenshot(full_page=True)
            self._write(f"tutorial-{name}.webp", webp(png))

    @asynccontextmanager
    async def _page(self) -> AsyncIterator[OpenedPage]:
        server = DashboardServer(BrokerAddress(HOST, self._broker.port), base=BASE)
        async with (
            chromium() as browser,
            server.listening(ListenAddress(HOST, 0)) as url,
            opened(browser, url) as page,
        ):
            yield page

    async def _terminal(self, shell: Shell, begin: str, before: str | None = None) -> None:
        """Run a command, or start a service, and draw the terminal."""
        command = self._command(begin)
        printed = await asyncio.to_thread(shell.run, command)
        if not printed:
            await asyncio.sleep(1.5)  # the first lines of a service
            files = sorted(self._logs.iterdir(), key=lambda path: int(path.stem))[-2:]
            printed = "".join(path.read_text(encoding="utf-8") for path in sorted(files))
        name, description = TERMINALS[begin]
        session = [(command, self._shown(printed))]
        if before is not None:
            session = [(self._command(before), ""), *session]
        drawn = terminal.picture(session, "jointfitd: tutorial", description)
        self._write(f"tutorial-{name}.svg", drawn.encode())

    def _shown(self, printed: str) -> str:
        """Return the last lines, with the default port and the folder of the tutorial."""
        own = printed.replace(str(self._reader), "~/jointfitd")
        own = re.sub(rf"\b{self._broker.port}\b", "1883", own)
        own = re.sub(
            r"^\S+ (\d\d:\d\d:\d\d),\d+ (\w+) [\w.]+: ", r"\1 \2 ", own, flags=re.MULTILINE
        )
        lines = own.splitlines()
        return "\n".join(lines[-MOST_LINES:] if len(lines) > MOST_LINES else lines)

    def _write(self, name: str, content: bytes) -> None:
        (self._pictures / name).write_bytes(content)
        print(f"{name}: {len(content) / 1000:.0f} kB", flush=True)

    async def _walk(self) -> None:
        """Collect the poses of the walking subject, and draw the limb."""
        poses: dict[str, list[dict[str, Any]]] = {"pose": [], "optical/pose": []}
        await asyncio.sleep(START_S)
        settings = MqttSettings(host=HOST, port=self._broker.port, base=BASE)
        async with MqttClient(settings) as client:
            await client.subscribe(*poses)
            try:
                async with asyncio.timeout(WALK_S):
                    async for topic, payload in client.messages():
                        poses[topic].append(payload)
            except TimeoutError:
                pass
        drawn = moving_limb.draw(moving_limb.walk(poses["pose"], poses["optical/pose"]))
        self._write("walking-leg.svg", drawn.encode())


async def recording_picture(page: OpenedPage) -> bytes:
    """Record with two marks by the buttons of the page; return a PNG of curve and recording."""
    await page.until_text("#angle-value", "°", 60)
    await page.page.click("text=Start recording")
    await asyncio.sleep(MARKED_S)
    await page.page.fill("#recording input", "heel strike")
    await page.page.keyboard.press("Escape")
    for _ in range(2):
        await page.page.keyboard.press("m")
        await asyncio.sleep(MARKED_S)
    views = await page.page.locator("#views").bounding_box()
    panel = await page.page.locator("#recording").bounding_box()
    assert views is not None
    assert panel is not None
    height = panel["y"] + panel["height"] + MARGIN_PX - views["y"]
    png = await page.page.screenshot(clip={**views, "height": height})
    await page.page.click("text=Stop recording")
    await page.page.click("#action .primary")
    await page.until_text("#action .answer", "Recorded")
    return png


def webp(png: bytes) -> bytes:
    """Return a picture as WebP."""
    packed = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").save(packed, "WEBP", quality=QUALITY, method=6)
    return packed.getvalue()


def run_tutorial(folder: Path, pictures: Path) -> None:
    """Run the tutorial in an empty folder; write its pictures."""
    broker = chosen_broker()(folder)
    broker.start()
    try:
        asyncio.run(TutorialRun(folder, broker, pictures).run())
    finally:
        broker.stop()
