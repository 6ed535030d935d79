"""The dashboard's page shows the state of the recording, and controls the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from tests.tools.dashboard.published_rig import RECORDING, RECORDING_FILE, STOPPED, PublishedRig
from tests.tools.dashboard.shown_page import shown

if TYPE_CHECKING:
    from tests.broker_fixture import Broker
    from tests.tools.dashboard.browser import OpenedPage

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(150)]

START, STOP = "#recording .record", "#recording .stop-recording"
BLANK = "() => document.querySelector('#toast').textContent === ''"


def sent(rig: PublishedRig, command: str) -> list[dict[str, Any]]:
    """Return the arguments of the requests of a command."""
    pairs = zip(rig.commands, rig.requests, strict=True)
    return [
        {key: value for key, value in request.items() if key != "transaction"}
        for name, request in pairs
        if name == command
    ]


async def test_a_recording_is_started_marked_and_stopped_by_the_keyboard(broker: Broker) -> None:
    rig = PublishedRig(recording=dict(STOPPED))
    async with shown(broker, rig) as page:
        keyboard = page.page.keyboard
        await page.until_text("#recording", "Off")
        assert await page.text("#recording-fact") == "off"
        await page.page.focus(START)
        await keyboard.press("Enter")
        await page.until_text("#recording", "0:00:0")
        assert RECORDING_FILE in await page.text("#recording")
        assert await page.page.evaluate(f"document.activeElement.matches('{STOP}')")

        await page.page.fill("#recording input", "step")
        for _ in range(2):  # the text remains in the field, so Enter repeats the mark
            await keyboard.press("Enter")
        await page.until_text("#recording [role=status]", "Mark 2 at")
        assert sent(rig, "mark") == [{"text": "step"}, {"text": "step"}]
        await page.page.wait_for_function("jointfit.store.events[0]?.kind === 'mark'")

        await page.page.focus(STOP)
        await keyboard.press("Enter")
        await page.until_text("#action", "not recorded")
        assert sent(rig, "record") == [{"action": "start"}]  # the stop is not confirmed yet
        await page.page.focus("#action .primary")
        await keyboard.press("Enter")
        await page.until_text("#action .answer", "nothing lost")
        command = f"jointfit report /var/lib/jointfitd/recordings/{RECORDING_FILE}"
        await page.until_text("#action .answer", command)
        assert await page.accessibility_faults() == []
        await keyboard.press("Escape")
        await page.until_text("#recording", "Last file")
        assert sent(rig, "record")[1:] == [{"action": "stop"}]
        assert page.errors == []


async def test_the_state_is_right_after_a_reload_of_the_page(broker: Broker) -> None:
    async with shown(broker, PublishedRig()) as page:
        for _ in range(2):
            await page.until_text("#recording .status", "0:12:")
            await page.until_text("#recording-fact", "0:12:")
            for words in (RECORDING_FILE, " MB", "nothing", "93.2 GB, for 16 days"):
                await page.until_text("#recording", words)
            await page.page.reload()


async def test_one_key_marks_in_every_view_but_not_while_typing(broker: Broker) -> None:
    rig = PublishedRig()
    async with shown(broker, rig) as page:
        await page.show("log")
        await page.page.keyboard.press("m")
        await page.until_text("#toast", "Mark 1 at")
        await page.page.fill("#view-log .mark-form input", "")
        await page.page.keyboard.type("moment")
        await page.page.keyboard.press("Escape")
        await page.page.keyboard.press("M")
        await page.until_text("#toast", "Mark 2 at")
        assert sent(rig, "mark") == [{"text": "mark"}, {"text": "mark"}]

        # Users of speech input, which types letters, can turn off the key M.
        await page.page.uncheck("#mark-key")
        await page.page.wait_for_function(BLANK, timeout=10_000)
        await page.page.keyboard.press("m")
        await page.page.reload()
        await page.until_text("#recording .status", "0:12:")
        assert not await page.page.is_checked("#mark-key")
        assert rig.marks == 2


async def test_a_full_disk_and_lost_messages_are_shown_with_the_remedy(broker: Broker) -> None:
    fault = "recordings/bench-1.mcap.part: No space left on device"
    interrupted = RECORDING | {"failure": fault, "lost": 312, "free_bytes": 0}
    async with shown(broker, PublishedRig(recording=interrupted)) as page:
        await page.until_text("#recording .status.error", "Interrupted")
        await page.until_text("#recording .status.warning", "312 messages")
        await page.until_text("#recording [role=alert]", f"{fault}. It resumes by itself")
        await page.until_text("#recording-fact", "interrupted")
        assert await page.accessibility_faults() == []


async def test_a_folder_that_cannot_be_written_is_named(broker: Broker) -> None:
    rig = PublishedRig(recording=dict(STOPPED))
    text = "the file cannot be created: correct the folder of [recording]"
    rig.answers["record"] = {"status": "error", "error": {"message": text}}
    async with shown(broker, rig) as page:
        await page.page.click(START)
        await page.until_text("#recording [role=alert]", f"jointfitd refuses: {text}")
        assert await is_off(page)


async def is_off(page: OpenedPage) -> bool:
    return await page.page.is_visible(START) and not await page.page.is_visible(STOP)
