"""Search for motion-capture streams of LSL, and diagnosis of missing frames.

The search queries the network once for each named host, or once for all hosts. The name of a host
only selects among the answers. The diagnosis connects in the same way as the driver.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from jointfit_daemon.device_search import Finding, FoundServer
from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_drivers.lsl_markers._channels import stream_layout
from jointfit_drivers.lsl_markers._decoder import LslMarkersDecoder
from jointfit_drivers.lsl_markers._library import addresses_of, load_library, search_streams
from jointfit_drivers.lsl_markers._session import SEARCH_S, LslSession
from jointfit_drivers.lsl_markers._settings import LslMarkersSettings
from jointfit_drivers.motion_capture import CHECK, Reception, content_findings
from jointfit_drivers.ports.udp_socket import local_address
from jointfit_protocols.lsl import parse_description

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.driver import Emit

_REMEDY = "start the LSL program of the camera software, and select markers or rigid bodies in it"
_MOST_STREAMS = 32
_PORT = 16_572
"""First network port of LSL. Senders use this port and the following ports."""


async def find_servers(
    hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
) -> list[FoundServer]:
    """Return the streams that answer; see `ServerSearch.find_servers`.

    The result is empty if the extra ``lsl`` is not installed. It is also empty if `port` is given:
    LSL has no fixed port, so a search with a port is for another device family.
    """
    if port is not None or not (hosts or broadcast):
        return []
    try:
        lsl = load_library()
    except DeviceMisconfiguredError:
        return []
    return await asyncio.to_thread(_search, lsl, hosts, broadcast, wait_s)


def _search(lsl: Any, hosts: Sequence[str], broadcast: bool, wait_s: float) -> list[FoundServer]:
    query = LslMarkersSettings(driver="lsl-markers").query()
    found = {}
    for server in [None] if broadcast else list(hosts):
        # The search takes its full duration, unless `_MOST_STREAMS` streams answer.
        for info in search_streams(lsl, query, server, least=_MOST_STREAMS, wait_s=wait_s):
            found[info.uid()] = info
    return [_describe_server(lsl, info, wait_s) for info in found.values()]


def _describe_server(lsl: Any, info: Any, wait_s: float) -> FoundServer:
    """Return the description of a stream, with the names of its markers and bodies."""
    markers: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    try:
        inlet = lsl.StreamInlet(info, recover=False)
        description = parse_description(inlet.info(timeout=wait_s).as_xml().encode())
    except RuntimeError:  # the sender has just ended
        description = ""
    if not isinstance(description, str):
        layout = stream_layout(description, LslMarkersSettings(driver="lsl-markers"))
        markers = tuple(entry.name for entry in layout.markers)
        bodies = tuple(entry.name for entry in layout.bodies)

    try:
        interface = local_address(min(addresses_of(info.hostname())), None)
    except (OSError, ValueError):
        interface = "an unknown network card"
    return FoundServer(
        driver="lsl-markers",
        server=info.hostname(),
        port=_PORT,
        interface=interface,
        application=f"LSL stream {info.name()}",
        version=f"{info.version() / 100:.2f}",
        protocol="LSL",
        transport="unicast",
        bodies=bodies,
        markers=markers,
        settings={"stream": info.name()},
    )


async def diagnose(settings: LslMarkersSettings, wait_s: float) -> list[Finding]:
    """Return the findings for a ``[mocap]`` table; see `Diagnosis.diagnose`."""
    patient = settings.model_copy(update={"silence_s": wait_s})

    async def connect(emit: Emit) -> None:
        await LslSession(patient, emit).run()

    name = settings.stream or settings.source_id or settings.server or "LSL"
    reception = Reception(LslMarkersDecoder(settings), connect)
    await reception.receive(2 * SEARCH_S + wait_s)
    if not reception.frames:
        text = str(reception.failure or f"no sample within {wait_s:g} s")
        return [Finding(CHECK, name, "error", text, _REMEDY)]
    return content_findings(settings, reception, name, _REMEDY)
