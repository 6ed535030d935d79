"""The physical test in the dashboard: a simulated hand follows its steps."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.child_processes import daemon as daemon_child
from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST
from tests.physical_test.turning_hand import Hand, held
from tests.tools.dashboard.browser import OpenedPage, chromium, opened

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [
    pytest.mark.system, pytest.mark.experiment, pytest.mark.real_time, pytest.mark.timeout(150),
]  # fmt: skip


async def follow(page: OpenedPage, hand: Hand) -> None:
    """Move the hand at each new instruction of the page, until cancelled."""
    shown = ""
    while True:
        text = await page.text("#physical-test .test-status")
        if text != shown:
            shown = text
            hand.follow(text.partition(": ")[2])
        await asyncio.sleep(0.1)


async def test_a_hand_that_follows_the_page_gets_the_lines_for_rig_toml(
    broker: Broker, tmp_path: Path
) -> None:
    server = DashboardServer(BrokerAddress(HOST, broker.port))
    async with held(tmp_path, world_to_sensor=True) as hand, chromium() as browser:
        rig = tmp_path / "rig.toml"
        rig.write_text(f'{rig.read_text()}[mqtt]\nhost = "{HOST}"\nport = {broker.port}\n')
        async with (
            daemon_child(tmp_path, rig),
            server.listening(ListenAddress(HOST, 0)) as url,
            opened(browser, url, size="phone") as page,
        ):
            await page.page.wait_for_function("() => jointfit.store.info !== null", timeout=30_000)
            await page.show("sensors")
            await page.page.select_option("#tested-sensor", "S1")
            await page.page.click("text=Start the test")
            following = asyncio.create_task(follow(page, hand))
            await page.until_text("#physical-test .test-status", "S1: not as configured", 60.0)
            following.cancel()
            found = await page.text("#physical-test")
            assert 'direction = "world_to_sensor"' in found
            assert "S1 sends: components w x y z, world to sensor" in found
            assert await page.accessibility_faults() == []

            # Sensor S2 is absent, and the page reports this.
            await page.page.select_option("#tested-sensor", "S2")
            await page.page.click("text=Start the test")
            await page.until_text("#physical-test .test-status.bad", "is not there", 30.0)
            assert page.errors == []
