"""The dashboard's page in Chromium draws a published rig, explains its state, and reconnects."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.outputs.mqtt import verify
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST
from tests.pictures.dashboard_pages import MOVING
from tests.tools.dashboard.browser import SIZES, VIEWS, chromium, opened
from tests.tools.dashboard.published_rig import PublishedRig, publishing
from tests.tools.dashboard.shown_page import shown

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(150)]

LIMB_PIXELS = """() => {
  const canvas = document.querySelector('#limb');
  return canvas.width + ':' + canvas.toDataURL().slice(0, 60000);
}"""

CUT_OFF = """() => {
  const shown = (selector) => [...document.querySelectorAll(`.view:not([hidden]) ${selector}`)];
  const tables = shown('.scroll').filter((table) => table.scrollWidth > table.clientWidth + 1);
  const wrapped = shown('.button').filter((button) => button.getBoundingClientRect().height > 46);
  return [...tables, ...wrapped].map((element) => element.ariaLabel ?? element.textContent);
}"""
"""JavaScript that returns tables wider than the view, and buttons with two lines."""


async def test_the_limb_moves_and_the_angle_has_a_standard_deviation(broker: Broker) -> None:
    async with shown(broker, PublishedRig()) as page:
        assert await page.text("#rig-name") == "bench-1"
        # The age is known after the first pose, which contains the time of the gateway.
        await page.until_text("#rig-state", "Calibrated, version 3, 2 h ago")
        assert await page.text("#angle-title") == "Knee flexion"
        assert await page.text("#angle-sd") == "± 2.1°"
        await page.page.wait_for_selector("#chart canvas", state="attached")
        pictures = set()
        for _ in range(5):
            pictures.add(await page.page.evaluate(LIMB_PIXELS))
            await asyncio.sleep(0.25)
        assert len(pictures) >= 4
        await page.until_text("#chart-caption", "difference from the cameras")
        # The chart is full after 20 s. On a busy machine, it then contains fewer poses.
        full = (
            "() => { const p = jointfit.store.poses; return p.at(-1).t_us - p[0].t_us > 19.5e6; }"
        )
        await page.page.wait_for_function(full, timeout=60_000)
        assert await page.page.evaluate("document.documentElement.scrollHeight - innerHeight") <= 0
        assert page.foreign == []
        assert page.errors == []


async def test_every_view_is_accessible_and_fits_phone_tablet_and_desktop(broker: Broker) -> None:
    server = DashboardServer(BrokerAddress(HOST, broker.port))
    async with (
        chromium() as browser,
        publishing(PublishedRig(), broker.port),
        server.listening(ListenAddress(HOST, 0)) as url,
    ):
        for scheme in ("light", "dark"):
            for size in SIZES:
                async with opened(browser, url, size=size, scheme=scheme) as page:
                    await page.until_text("#angle-value", "°")
                    for view in VIEWS:
                        await page.show(view)
                        await page.picture(f"{view}-{size}-{scheme}")
                        overflow = "document.documentElement.scrollWidth - innerWidth"
                        assert await page.page.evaluate(overflow) <= 0, (view, size)
                        assert await page.page.evaluate(CUT_OFF) == [], (view, size)
                        if size != "tablet":
                            assert await page.accessibility_faults() == [], (view, size, scheme)
                    assert page.errors == []


async def test_loss_of_daemon_and_broker_is_named_and_ends_by_itself(broker: Broker) -> None:
    server = DashboardServer(BrokerAddress(HOST, broker.port))
    async with (
        chromium() as browser,
        server.listening(ListenAddress(HOST, 0)) as url,
        opened(browser, url) as page,
    ):
        await page.until_text("#empty", "Waiting for jointfitd")
        async with publishing(PublishedRig(), broker.port):
            await page.until_text("#angle-value", "°")
            broker.stop()
            await page.until_text("#banner", f"{HOST}:{broker.port}")
            await page.until_text("#banner", "start the broker")
            await page.until_text("#main-action", "Reconnect")
            broker.start()
            await page.until_text("#rig-state", "Calibrated, version 3")
            await page.until_text("#angle-value", "°")
        await page.until_text("#rig-state", "jointfitd is not running")
        await page.until_text("#angle-reason", "No pose for")
        assert await page.text("#angle-value") == "–"
        async with publishing(PublishedRig(), broker.port):
            await page.until_text("#angle-value", "°")
        assert page.errors == []


async def test_names_in_any_script_a_missing_sensor_and_a_wrong_clock_are_shown(
    broker: Broker,
) -> None:
    rig = PublishedRig(
        "膝関節 <b>&</b>",
        {"бедро": ["датчик 1", "constructor"], "ساق": ["__proto__", "S4"]},
        clock_offset_s=-9 * 3600,
        offline=frozenset({"S4"}),
    )
    async with shown(broker, rig) as page:
        assert await page.text("#rig-name") == "膝関節 <b>&</b>"
        cards = await page.text("#cards")
        for name in ("датчик 1", "constructor", "__proto__", "ساق"):
            assert name in cards
        await page.until_text(".card.error", "S4")
        await page.until_text(".card.error", "No data: check cable and power")
        await page.show("table")
        await page.until_text("#view-table", "Knee flexion")
        assert page.errors == []


async def test_a_request_is_sent_and_a_refusal_is_shown_in_words(broker: Broker) -> None:
    rig = PublishedRig()
    rig.answer = {"status": "error", "error": {"message": "S4 sends no data: check its cable"}}
    async with shown(broker, rig) as page:
        await page.page.click("#main-action")
        await page.page.click(".rail >> text=Stand still")
        await page.page.click("text=Start standing")
        await page.until_text("#view-calibrate .banner", "S4 sends no data: check its cable")
        assert [request["phase"] for request in rig.requests] == ["static"]


@pytest.mark.parametrize(
    ("phase", "words", "button"),
    [
        ("functional", "Calibrating: move every joint", "Show this step"),
        ("aligned", "Sensors aligned; the static pose is next", "Show the steps"),
    ],
)
async def test_a_first_calibration_is_explained_where_the_limb_will_be(
    broker: Broker, phase: str, words: str, button: str
) -> None:
    rig = PublishedRig(calibrated=False, changes={"phase": phase, "version": None, "quality": {}})
    server = DashboardServer(BrokerAddress(HOST, broker.port))
    async with (
        chromium() as browser,
        publishing(rig, broker.port),
        server.listening(ListenAddress(HOST, 0)) as url,
        opened(browser, url) as page,
    ):
        await page.until_text("#empty", words)
        assert await page.page.is_hidden("#limb-panel")
        assert await page.page.is_visible("#cards")
        assert await page.accessibility_faults() == []
        await page.page.click(f"#empty >> text={button}")
        await page.page.wait_for_selector("#view-calibrate", state="visible")
        assert page.errors == []


TICKS = "[...document.querySelectorAll('.rail .done .rail-title')].map((each) => each.textContent)"


@pytest.mark.parametrize(
    ("state", "ticks"),
    [
        ({"phase": "functional", "done": ["align", "static"]}, ["Align", "Stand still"]),
        ({"phase": "fitting", "text": "fitting the static trial", "done": ["align"]}, ["Align"]),
        (
            {
                "phase": "static",
                "version": 3,
                "done": ["static"],
            },  # the pose is repeated while version 3 is active
            ["Align", "Move"],
        ),
    ],
    ids=["first movement", "fit of the pose", "pose again"],
)
async def test_finished_steps_have_ticks_in_a_page_that_is_opened_during_a_step(
    broker: Broker, state: dict[str, Any], ticks: list[str]
) -> None:
    rig = PublishedRig()
    in_force = state.get("version") is not None
    rig.changes = {"version": None, "quality": {}} | state
    if in_force:
        del rig.changes["quality"]
    async with shown(broker, rig) as page:
        await page.show("calibrate")
        await page.page.wait_for_selector(".step.running")
        assert await page.page.evaluate(TICKS) == ticks


async def test_a_limb_of_unknown_lengths_is_drawn_with_assumed_ones(broker: Broker) -> None:
    async with shown(broker, PublishedRig(lengths_known=False)) as page:
        await page.until_text("#limb-caption", "Unknown length of Thigh, Shank: drawn with 0.4 m")
        drawn = "jointfit.limb.camera.length"
        await page.page.wait_for_function(f"() => Math.abs({drawn} - 0.8) < 0.01")


@pytest.mark.parametrize("size", SIZES)
async def test_tabs_tables_and_buttons_are_whole(broker: Broker, size: str) -> None:
    moving = PublishedRig(changes={"phase": "functional"}, progress=MOVING)
    async with shown(broker, moving, size=size) as page:
        tabs = "document.querySelector('.tabs').scrollWidth - innerWidth"
        assert await page.page.evaluate(tabs) <= 0
        for view, text in {
            "calibrate": "Predicted errors", "history": "Use version 2", "sensors": "Latency",
            "table": "Joint positions",
        }.items():  # fmt: skip
            await page.show(view)
            await page.until_text(f"#view-{view}", text)
            assert await page.page.evaluate(CUT_OFF) == [], view


async def test_a_stored_calibration_is_chosen_in_the_history(broker: Broker) -> None:
    rig = PublishedRig()
    async with shown(broker, rig) as page:
        await page.show("history")
        await page.until_text("#view-history", "in force: online learning, round 1")
        await page.until_text("#view-history", "Knee flexion 1.9° RMS, newest movement")
        await page.until_text("#view-history", "Online learning, round 1: error on the newest")
        await page.page.click("text=Use version 2")
        async with asyncio.timeout(30):
            while len(rig.requests) < 2:
                await asyncio.sleep(0.02)
        assert rig.requests[1]["version"] == 2
        await page.show("log")
        await page.page.fill("#view-log input[maxlength]", "first step")
        await page.page.keyboard.press("Enter")
        await page.until_text("#view-log [role=status]", "first step")
        assert rig.requests[-1]["text"] == "first step"


KEY = "0123456789abcdef0123456789abcdef"


async def test_requests_are_signed_with_the_key_that_the_user_enters(broker: Broker) -> None:
    rig = PublishedRig(clock_offset_s=5 * 3600)
    rig.answer = {"status": "error", "error": {"message": "this rig accepts signed requests only"}}
    async with shown(broker, rig) as page:
        await page.show("calibrate")
        await page.page.click(".rail >> text=Stand still")
        await page.page.click("text=Start standing")
        await page.page.fill("#key-value", KEY)
        rig.answer = {"status": "accepted", "data": {}, "error": None}
        await page.page.click("#key-send")
        async with asyncio.timeout(10):
            while not any("signature" in request for request in rig.requests):
                await asyncio.sleep(0.05)
    topic = f"{rig.base}/bridge/request/calibrate"
    verify(KEY.encode(), topic, rig.requests[-1], rig.now_us())


async def test_keys_move_between_the_views_and_turn_the_limb(broker: Broker) -> None:
    async with shown(broker, PublishedRig()) as page:
        await page.page.focus("#limb")
        before = await page.page.evaluate("jointfit.limb.camera.turn")
        await page.page.keyboard.press("ArrowLeft")
        assert await page.page.evaluate("jointfit.limb.camera.turn") > before
        await page.page.focus("#tab-live")
        await page.page.keyboard.press("End")
        await page.until_text("#view-table", "Joint angles")
        assert await page.page.get_attribute("#tab-table", "aria-selected") == "true"
