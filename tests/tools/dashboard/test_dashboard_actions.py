"""The dashboard's page sends the requests of its menu, and guides through the checks of sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from tests.tools.dashboard.published_rig import PublishedRig
from tests.tools.dashboard.shown_page import shown

if TYPE_CHECKING:
    from tests.broker_fixture import Broker
    from tests.tools.dashboard.browser import OpenedPage

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(150)]

FAULTS = [{"key": "mqtt.port", "message": "mqtt.port: expected 1 to 65535"},
          {"key": "rig.name", "message": "rig.name: expected a name"}]  # fmt: skip
ANSWERS: dict[str, dict[str, Any]] = {
    "mark": {"status": "ok", "data": {"number": 4, "t_us": 1795250060351823, "text": "step"}},
    "rate": {"status": "ok", "data": {"before_hz": 100.0, "output_rate_hz": 50.0}},
    "restart-device": {"status": "accepted", "data": {"device": "S1"}},
    "selftest": {
        "status": "ok",
        "data": {
            "level": "warning",
            "checks": [
                {"check": "device", "id": "S1", "level": "ok", "text": "streams", "remedy": ""},
                {"check": "disk", "id": "", "level": "warning", "text": "98 % full",
                 "remedy": "delete old recordings"},
            ],
        },
    },
    "reload": {"status": "error", "error": {"message": "2 faults in rig.toml", "faults": FAULTS}},
}  # fmt: skip
CASES: list[tuple[str, str, dict[str, Any], tuple[str, ...]]] = [
    ("Mark this instant", "mark", {"text": "step"}, ("Mark 4 at", "step")),
    ("Output rate", "rate", {"hz": 50}, ("The output rate is 50 Hz; before: 100 Hz.",)),
    ("Self-test", "selftest", {}, ("1 of 2 checks passed", "98 % full", "delete old recordings")),
    ("Reload rig.toml", "reload", {}, ("2 faults in rig.toml", "mqtt.port", "rig.name")),
]
"""Entry of the menu, command, arguments, and parts of the displayed answer."""


def sent(rig: PublishedRig) -> dict[str, Any]:
    """Return the last request without its transaction."""
    return {key: value for key, value in rig.requests[-1].items() if key != "transaction"}


async def open_entry(page: OpenedPage, entry: str) -> None:
    """Choose an entry of the menu."""
    await page.page.click("#menu-button")
    await page.page.click(f"#menu >> text={entry}")


async def test_each_entry_of_the_menu_sends_its_request_and_shows_the_answer(
    broker: Broker, subtests: pytest.Subtests
) -> None:
    rig = PublishedRig()
    rig.answers |= ANSWERS
    async with shown(broker, rig) as page:
        for entry, command, arguments, parts in CASES:
            with subtests.test(command):
                await open_entry(page, entry)
                for value in arguments.values():
                    await page.page.fill("#action input", str(value))
                if command != "selftest":
                    assert sent_count(rig, command) == 0  # the user has not confirmed yet
                    await page.page.click("#action .primary")
                for part in parts:
                    await page.until_text("#action .answer", part)
                assert rig.commands[-1] == command
                assert sent(rig) == arguments
                assert await page.accessibility_faults() == []
                await page.page.click("#action .buttons .button:not(.primary)")
        assert page.errors == []


def sent_count(rig: PublishedRig, command: str) -> int:
    """Return the number of requests of a command."""
    return rig.commands.count(command)


async def test_a_device_is_restarted_from_its_row_after_a_confirmation(broker: Broker) -> None:
    rig = PublishedRig()
    rig.answers |= ANSWERS
    async with shown(broker, rig) as page:
        await page.show("sensors")
        await page.page.click('[aria-label="Restart S1"]')
        await page.until_text("#action", "Its data are missing for some seconds")
        await page.page.click("#action >> text=Cancel")
        assert rig.requests == []
        await page.page.click('[aria-label="Restart S1"]')
        await page.page.click("#action .primary")
        await page.until_text("#action .answer", "S1 restarts")
        assert sent(rig) == {"device": "S1"}


async def test_a_static_pose_starts_from_the_menu_and_opens_the_calibration(
    broker: Broker,
) -> None:
    rig = PublishedRig()
    async with shown(broker, rig) as page:
        await open_entry(page, "Record the static pose again")
        await page.page.click("#action .primary")
        await page.page.wait_for_selector("#view-calibrate", state="visible")
        assert rig.commands == ["static"]


@pytest.mark.parametrize(("axis", "degrees", "text"), [
    ("x", 90.0, "turned 90° about +x"), ("z", -45.0, "turned 45° about −z"),
])  # fmt: skip
async def test_the_check_of_axes_names_the_axis_and_the_angle_of_a_turned_sensor(
    broker: Broker, axis: str, degrees: float, text: str
) -> None:
    rig = PublishedRig()
    async with shown(broker, rig) as page:
        await page.show("sensors")
        assert "are not published" not in await page.text("#view-sensors")
        await page.until_text("#view-sensors .turn", "not turned")
        rig.turned["S1"] = (axis, degrees)
        await page.until_text("#view-sensors .card.turned .turn", text)
        assert await page.page.locator(".card.turned h3").all_inner_texts() == ["S1"]
        await page.page.click("text=Set all to zero")
        await page.page.wait_for_function("() => !document.querySelector('.card.turned')")


async def test_the_check_of_axes_continues_after_a_loss_of_the_broker(broker: Broker) -> None:
    async with shown(broker, PublishedRig()) as page:
        await page.show("sensors")
        await page.until_text("#view-sensors .lead", "Up in the drawing")
        broker.stop()
        await page.until_text("#main-action", "Reconnect")
        await page.until_text("#view-sensors .lead", "Waiting for the orientations")
        broker.start()
        await page.until_text("#view-sensors .lead", "Up in the drawing")


STEPS = [
    "Lay S1 flat, its z axis up, and let go.",
    "Turn it on the table by a quarter turn, counter-clockwise seen from above, and let go.",
    "Tip it by a quarter turn about its x axis, so that its y axis points up, and hold it still.",
    "Turn it, as it stands, by a quarter turn, counter-clockwise seen from above.",
]
TURNING: dict[str, Any] = {
    "device": "S1", "state": "turning", "step": 2, "steps": STEPS, "text": None, "result": None,
    "rotations": ["about the vertical", "about its x axis", "about the vertical, tipped"],
}  # fmt: skip
JUDGED: dict[str, Any] = TURNING | {
    "state": "finished", "step": 4,
    "result": {
        "id": "S1", "agrees": False, "deviations_deg": [180.0, 88.0, 120.0],
        "found": "components w x y z, world to sensor, +z of the world points up, sensor axes as"
        " printed",
        "rig_toml": ['direction = "world_to_sensor"'], "alternatives": [],
        "lines": ["S1: not as configured", "in its [[imu]] table of rig.toml:\n…"],
    },
}  # fmt: skip


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", ["phone", "desktop"])
async def test_the_physical_test_guides_step_by_step_and_ends_with_lines_for_rig_toml(
    broker: Broker, size: str, scheme: str
) -> None:
    rig = PublishedRig()
    rig.answers["physical-test"] = {"status": "ok", "data": TURNING}
    async with shown(broker, rig, size=size, scheme=scheme) as page:
        await page.show("sensors")
        await page.page.click("text=Start the test")
        await page.until_text("#physical-test .test-status", f"Step 3 of 4: {STEPS[2]}")
        assert await page.text("#physical-test [aria-current]") == STEPS[2]
        assert await page.accessibility_faults() == []
        await page.picture(f"physical-test-{size}-{scheme}")

        rig.answers["physical-test"] = {"status": "ok", "data": JUDGED}
        await page.until_text("#physical-test .test-status", "S1: not as configured")
        assert await page.text("#physical-test pre") == 'direction = "world_to_sensor"'
        assert await page.page.is_visible("text=Start the test")
        assert await page.accessibility_faults() == []
        await page.picture(f"physical-test-outcome-{size}-{scheme}")
        width = await page.page.evaluate("document.documentElement.scrollWidth - innerWidth")
        assert width <= 0  # the page is not wider than the window
        assert page.errors == []
