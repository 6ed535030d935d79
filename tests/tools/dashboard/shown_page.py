"""The dashboard's page with a `PublishedRig`, for tests."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST
from tests.tools.dashboard.browser import OpenedPage, chromium, opened
from tests.tools.dashboard.published_rig import PublishedRig, publishing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.broker_fixture import Broker


@asynccontextmanager
async def shown(broker: Broker, rig: PublishedRig, **window: Any) -> AsyncIterator[OpenedPage]:
    """Yield the page of a rig once it shows an angle."""
    server = DashboardServer(BrokerAddress(HOST, broker.port))
    async with (
        chromium() as browser,
        publishing(rig, broker.port),
        server.listening(ListenAddress(HOST, 0)) as url,
        opened(browser, url, **window) as page,
    ):
        await page.until_text("#angle-value", "°")
        yield page
