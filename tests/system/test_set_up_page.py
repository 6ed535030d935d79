"""The set-up page of the dashboard in a browser: questions, a reload, the written rig."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from jointfit_daemon.tools.dashboard.set_up import SetUpServer, set_up_server
from tests.broker_fixture import HOST
from tests.tools.dashboard.browser import SIZES, chromium, opened

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.tools.dashboard.browser import OpenedPage

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(300)]

TYPED = {
    "name": "膝 / 1",
    "sensors.thigh": "עליון",
    "sensors.shank": "shank-front",
    "device.עליון": "/dev/ttyUSB0",
    "device.shank-front": "can0",
    "ids.shank-front": "0x105 0x106 0x121",
    "username": "gateway",
}
"""Answers to questions without a suitable proposal; the first answer to `name` is refused."""
PASSWORD = "Zx9-geheim"


@contextlib.asynccontextmanager
async def served(folder: Path) -> AsyncIterator[tuple[SetUpServer, str]]:
    """Yield a server with the set-up page, and the address of the page."""
    server = set_up_server(DashboardServer(BrokerAddress(HOST, 1)), folder / "rig.toml")
    assert server.session is not None
    server.session.search.network = False
    async with server.listening(ListenAddress(HOST, 0)) as url:
        yield server, f"{url}set-up.html"


async def answer(page: OpenedPage, server: SetUpServer) -> str | None:
    """Answer the current question; return its name, or None if no question is left."""
    assert server.session is not None
    question = server.session.handle({"do": "show"})["question"]
    if question is None:
        return None
    await page.until_text("#question-text", question["text"])
    name = str(question["name"])
    if name in TYPED:
        await page.page.fill("#typed", TYPED[name])
    await page.page.click("button.primary")
    return name


async def next_question(page: OpenedPage, number: int) -> None:
    """Wait until `number` questions are answered."""
    await page.page.wait_for_function(
        "(number) => document.querySelectorAll('#answers dt').length === number", arg=number
    )


async def test_the_page_asks_continues_after_a_reload_and_writes_the_rig(tmp_path: Path) -> None:
    async with (
        chromium() as browser,
        served(tmp_path) as (server, url),
        opened(browser, url) as page,
    ):
        await page.until_text("#question-count", "Question 1")
        await answer(page, server)
        await page.until_text("#question-error", "must not contain /")
        await page.page.fill("#typed", "膝 1")
        await page.page.press("#typed", "Enter")
        await next_question(page, 1)

        done = 1
        while await answer(page, server) is not None:
            done += 1
            await next_question(page, done)
            if done == 5:
                await page.page.reload()
                await next_question(page, done)
        await page.until_text("#question-text", "Check and write")
        await page.page.fill("#password", PASSWORD)
        await page.picture("set-up-complete")
        assert await page.accessibility_faults() == []
        await page.page.click("text=Write rig.toml")
        await page.until_text("#question-text", "The rig is written")
        await page.picture("set-up-written")
        assert await page.accessibility_faults() == []
        assert (page.errors, page.foreign) == ([], [])

    rig = load_rig(tmp_path / "rig.toml")
    assert rig.name == "膝 1"
    assert [source.id for source in rig.sources] == ["עליון", "shank-front"]
    assert (tmp_path / "mqtt-password").stat().st_mode & 0o777 == 0o600
    assert PASSWORD not in (tmp_path / "rig.toml").read_text()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", sorted(SIZES))
async def test_a_question_fits_every_window_and_theme(
    tmp_path: Path, size: str, scheme: str
) -> None:
    async with chromium() as browser, served(tmp_path) as (server, url):
        assert server.session is not None
        server.session.handle({"do": "answer", "value": "bench-1"})
        async with opened(browser, url, size=size, scheme=scheme) as page:
            await page.until_text("#question-text", "Limb")
            await page.picture(f"set-up-{size}-{scheme}")
            assert await page.accessibility_faults() == []
            width = await page.page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert width <= 0


async def test_the_answer_that_was_chosen_or_typed_last_is_sent(tmp_path: Path) -> None:
    typed = {"device.thigh-front": "can0", "sensors.thigh": "thigh-front"}
    async with chromium() as browser, served(tmp_path) as (server, url):
        assert server.session is not None
        session = server.session
        question = session.handle({"do": "show"})["question"]
        while question["name"] != "ids.thigh-front":
            reply = {"do": "answer", "value": typed.get(question["name"], "")}
            question = session.handle(reply)["question"]

        async with opened(browser, url) as page:
            await page.until_text("#question-text", "CAN identifiers of the sensor thigh-front")
            later = page.page.locator("input[value=later]")
            assert await later.is_checked()  # nothing was received
            await page.page.fill("#typed", "0x105 0x106 0x121")
            assert not await later.is_checked()
            await later.check()
            assert await page.page.input_value("#typed") == ""
            assert await page.accessibility_faults() == []
            await page.picture("set-up-later")
            await page.page.click("button.primary")
            await page.until_text("#question-text", "Connection of the sensor")
            assert session.dialogue.answers["ids", "thigh-front"] == "later"
