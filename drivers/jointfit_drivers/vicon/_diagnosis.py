"""Search for a DataStream server at named hosts, and diagnosis of "connected, but no data".

The protocol has no discovery, so only hosts with a known name or address are queried. Search and
diagnosis connect in the same way as the driver.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding, FoundServer
from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.motion_capture import CHECK, Reception, content_findings, find_route
from jointfit_drivers.vicon._decoder import ViconDecoder
from jointfit_drivers.vicon._session import OFFER_S, ViconSession
from jointfit_drivers.vicon._settings import PORT, ViconSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.driver import Emit

_LOOPBACK = "127.0.0.1"
_STREAM = "tick the subjects in the Vicon software, and enable their output"


async def find_servers(
    hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
) -> list[FoundServer]:
    """Return the DataStream servers that answer; see `ServerSearch.find_servers`."""
    asked = dict.fromkeys([*hosts, *([_LOOPBACK] if broadcast else [])])
    tables = [
        ViconSettings(driver="vicon", server=host, command_port=port or PORT) for host in asked
    ]
    for table in tables:
        try:
            await find_route("Vicon", table)
        except DeviceLostError as error:
            raise OSError(str(error)) from None
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(_ask_host(table, wait_s)) for table in tables]
    return [server for task in tasks for server in task.result()]


async def _ask_host(settings: ViconSettings, wait_s: float) -> list[FoundServer]:
    """Return the server at an address with its names; empty if it does not answer."""
    route = await find_route("Vicon", settings)
    reception = await _receive(settings, wait_s)
    if "model" not in reception.facts:
        return []
    layout = reception.frames[-1].layout if reception.frames else None
    return [
        FoundServer(
            driver="vicon",
            server=route.host,
            port=settings.command_port,
            interface=route.local,
            application="Vicon",
            version="",
            protocol="DataStream",
            transport="unicast",
            bodies=() if layout is None else layout.bodies,
            markers=() if layout is None else layout.markers,
        )
    ]


async def diagnose(settings: ViconSettings, wait_s: float) -> list[Finding]:
    """Return the findings for a ``[mocap]`` table; see `Diagnosis.diagnose`."""
    name = settings.server
    reception = await _receive(settings.model_copy(update={"silence_s": wait_s}), wait_s + OFFER_S)
    if reception.frames:
        return content_findings(settings, reception, name, _STREAM)

    failure = reception.failure
    text = "no answer" if failure is None else str(failure)
    if "model" not in reception.facts or isinstance(failure, DeviceMisconfiguredError):
        remedy = f"set server and command_port in [mocap]; allow TCP {settings.command_port}"
        return [Finding(CHECK, name, "error", text, f"{remedy} in firewalls; ping {name}")]
    text = "the server answers, but sends no frame"
    remedy = "go live in the Vicon software, or play a recording"
    return [Finding(CHECK, name, "error", text, remedy)]


async def _receive(settings: ViconSettings, limit_s: float) -> Reception:
    """Receive frames in the same way as the driver, and return the reception."""

    async def connect(emit: Emit) -> None:
        await ViconSession(settings, await find_route("Vicon", settings), emit).run()

    reception = Reception(ViconDecoder(settings), connect)
    await reception.receive(limit_s)
    return reception
