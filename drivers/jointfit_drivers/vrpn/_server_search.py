"""Search for VRPN servers, and diagnosis of missing poses.

VRPN has no discovery, so only hosts with a known name are queried. The diagnosis connects in the
same way as the driver.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding, FoundServer
from jointfit_drivers.motion_capture import (
    CHECK,
    Reception,
    content_findings,
    find_route,
    host_address,
)
from jointfit_drivers.ports.udp_socket import local_address
from jointfit_drivers.vrpn._decoder import VrpnDecoder
from jointfit_drivers.vrpn._session import CONNECT_S, VrpnSession
from jointfit_drivers.vrpn._settings import VrpnSettings
from jointfit_protocols.vrpn import DEFAULT_PORT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.driver import Emit

_REMEDY = "enable VRPN streaming and rigid bodies in the camera software"


def _reception(settings: VrpnSettings, silence_s: float) -> Reception:
    """Return a reception that connects to the server in the same way as the driver."""
    patient = settings.model_copy(update={"silence_s": silence_s})

    async def connect(emit: Emit) -> None:
        route = await find_route("VRPN", patient)
        await VrpnSession(patient, route, emit).run()

    return Reception(VrpnDecoder(settings), connect)


async def find_servers(
    hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
) -> list[FoundServer]:
    """Return the VRPN servers that answer; see `ServerSearch.find_servers`."""
    addresses = ["127.0.0.1"] if broadcast else []
    addresses += [await host_address(host) for host in hosts]

    unique = list(dict.fromkeys(addresses))
    async with asyncio.TaskGroup() as group:
        asked = [
            group.create_task(_ask(address, port or DEFAULT_PORT, wait_s)) for address in unique
        ]
    return [server for task in asked if (server := task.result()) is not None]


async def _ask(address: str, port: int, wait_s: float) -> FoundServer | None:
    """Return the server at an address with the bodies that it reports; None without answer."""
    settings = VrpnSettings(driver="vrpn", server=address, port=port)
    reception = _reception(settings, wait_s)
    await reception.receive(wait_s)
    version = str(reception.facts.get("vrpn", ""))
    if not version:
        return None
    return FoundServer(
        driver="vrpn",
        server=address,
        port=port,
        interface=local_address(address, None),
        application="VRPN server",
        version=version,
        protocol=f"VRPN {version}",
        transport="unicast",
        bodies=reception.frames[-1].layout.bodies if reception.frames else (),
    )


async def diagnose(settings: VrpnSettings, wait_s: float) -> list[Finding]:
    """Return the findings for a ``[mocap]`` table; see `Diagnosis.diagnose`."""
    name, reception = settings.server, _reception(settings, wait_s)
    await reception.receive(2 * CONNECT_S + wait_s)
    if not reception.frames:
        text = str(reception.failure or f"no pose within {wait_s:g} s")
        return [Finding(CHECK, name, "error", text, _REMEDY)]
    # The last frame is used, because the first frames lack bodies that reported later.
    layout = reception.frames[-1].layout
    reception.frames = [frame for frame in reception.frames if frame.layout == layout]
    return content_findings(settings, reception, name, _REMEDY)
