"""Pictures of the dashboard's calibration and check of axes, with prepared messages of a rig."""

from __future__ import annotations

import asyncio
import io
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from jointfit_daemon.tools.dashboard.addresses import BrokerAddress, ListenAddress
from jointfit_daemon.tools.dashboard.server import DashboardServer
from tests.broker_fixture import HOST, chosen_broker
from tests.pictures.tutorial_run import SHOW_BROKER, webp
from tests.tools.dashboard.browser import OpenedPage, chromium, opened
from tests.tools.dashboard.published_rig import STOPPED, PublishedRig, publishing

if TYPE_CHECKING:
    from playwright.async_api import Browser

    from tests.broker_fixture import Broker

SHOWN = 2 / 3
"""Size of a picture of the calibration relative to the size of the browser window."""
SETTLE_S = 3.0
"""Time after which a page has the clock of the gateway and its first curve, s."""
UNKNOWN_JOINT = {
    "source": "unknown", "predicted_error_mm": None, "noise_error_mm": None, "arc_deg": None,
    "met": False,
}  # fmt: skip
MOVING = {
    "phase": "functional",
    "progress": 0.3,
    "text": "hip: movement too small: squat, and swing the leg forward and back",
    "data": {
        "joints": {
            "hip": UNKNOWN_JOINT,
            "knee": {
                "source": "markers, static pose", "predicted_error_mm": 24.1,
                "noise_error_mm": 2.3, "arc_deg": 61.0, "met": False,
            },
            "ankle": UNKNOWN_JOINT,
        },
        "parts": {
            name: {"seen_pct": share}
            for name, share in (("pelvis", 98.0), ("thigh", 99.0), ("shank", 100.0))
        },
        "missing": [
            "hip: movement too small: squat, and swing the leg forward and back",
            "knee: 5 of 12 flexions so far: walk, squat, sit down and stand up",
            "ankle: movement too small: lift the foot and bend it up and down",
        ],
    },
}  # fmt: skip
TURNING = {
    "phase": "align", "progress": 0.62, "text": "keep turning the plate about several axes",
    "data": {},
}  # fmt: skip

RESULT = {
    "static": {"still_s": 4.9, "spread_deg": {"S1": 0.7, "S2": 1.0, "S3": 0.7, "S4": 0.8}},
    "alignment": {
        name: {"error_deg": error, "rms_deg": rms, "lag_ms": None}
        for name, error, rms in (
            ("S1", 0.4, 3.8), ("S2", 0.3, 4.0), ("S3", 0.3, 5.2), ("S4", 0.4, 4.2),
        )
    },
    "anatomy": {
        "joints": {
            "hip": {"source": "markers", "sd_m": 0.017, "arc_deg": 92.0},
            "knee": {"source": "markers, static pose", "sd_m": 0.018, "arc_deg": 93.0},
            "ankle": {"source": "markers, static pose", "sd_m": 0.023, "arc_deg": 41.0},
        },
        "lengths_m": {"thigh": 0.429, "shank": 0.393},
        "length_sd_m": {"thigh": 0.022, "shank": 0.034},
        "length_sources": {"thigh": "markers", "shank": "markers"},
    },
    "holdout": {
        "method": "anchored",
        "segments_deg": {
            "thigh": {"anchored": 2.8, "mean": 7.6, "single": 7.6},
            "shank": {"anchored": 2.8, "mean": 5.0, "single": 6.1},
        },
        "flexion_deg": {"knee": {"anchored": 2.4, "mean": 2.7, "single": 4.1}},
    },
}  # fmt: skip
"""Quality that a run of the demo reported."""


def calibrating(
    phase: str, done: tuple[str, ...], progress: dict[str, Any] | None = None
) -> PublishedRig:
    """Return a rig during its first calibration."""
    state: dict[str, Any] = {
        "phase": phase,
        "version": None,
        "quality": {},
        "done": [*done],
        "text": "",
    }
    return rig(calibrated=False, changes=state, progress=progress)


def rig(**settings: Any) -> PublishedRig:
    """Return the rig of the tutorial."""
    return PublishedRig("demo", base="jointfit/demo", recording=dict(STOPPED), **settings)


STEPS = {
    "calibrate-align": (calibrating("align", (), TURNING), ".percent"),
    "calibrate-static": (calibrating("aligned", ("align",)), "text=Start standing"),
    "calibrate-move": (calibrating("functional", ("align", "static"), MOVING), ".missing li"),
    "calibrate-result": (rig(changes={"version": 1, "quality": RESULT}), ".good"),
}
"""Rig, and an element of its page, for each picture of the calibration."""


async def _photograph(broker: Broker, browser: Browser, url: str, pictures: Path) -> None:
    for name, (shown, element) in STEPS.items():
        async with publishing(shown, broker.port), opened(browser, url) as page:
            await page.show("calibrate")
            await page.page.wait_for_selector(f"#view-calibrate >> {element}", state="visible")
            png = await _settled(page)
            smaller = io.BytesIO()
            with Image.open(io.BytesIO(png)) as image:
                width, height = image.size
                image.resize((round(SHOWN * width), round(SHOWN * height))).save(smaller, "PNG")
            (pictures / f"{name}.webp").write_bytes(webp(smaller.getvalue()))

    turned = rig()
    async with publishing(turned, broker.port), opened(browser, url) as page:
        await page.show("sensors")
        await page.until_text("#view-sensors .turn", "not turned")
        turned.turned["S1"] = ("x", 90.0)
        await page.until_text(".card.turned .turn", "turned 90° about +x")
        panel = page.page.locator(".panel", has_text="Check of axes")
        (pictures / "axes.webp").write_bytes(webp(await panel.screenshot()))


async def _settled(page: OpenedPage) -> bytes:
    """Return a PNG of the settled page, which shows the default port of the broker."""
    await asyncio.sleep(SETTLE_S)
    await page.page.evaluate(SHOW_BROKER, f"{HOST}:1883")
    return await page.page.screenshot()


async def _draw(broker: Broker, pictures: Path) -> None:
    server = DashboardServer(BrokerAddress(HOST, broker.port), base="jointfit/demo")
    async with chromium() as browser, server.listening(ListenAddress(HOST, 0)) as url:
        await _photograph(broker, browser, url, pictures)


def draw_pages(pictures: Path) -> None:
    """Write the pictures of the calibration and of the check of axes."""
    with tempfile.TemporaryDirectory(prefix="jointfit-pictures-") as folder:
        broker = chosen_broker()(Path(folder))
        broker.start()
        try:
            asyncio.run(_draw(broker, pictures))
        finally:
            broker.stop()
