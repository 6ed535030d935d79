"""Search for QTM servers: by UDP discovery in a network, or by a TCP connection to a named host.

The settings of a named host are requested as well, because they contain the names of its rigid
bodies and markers.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.device_search import FoundServer
from jointfit_daemon.driver import DeviceLostError
from jointfit_drivers.motion_capture import Route, find_route, gather_servers, run_until
from jointfit_drivers.ports.network_cards import broadcast_networks
from jointfit_drivers.qtm._binding import bind_settings
from jointfit_drivers.qtm._session import QtmSession
from jointfit_drivers.qtm._settings import PORT, QtmSettings
from jointfit_protocols import qtm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Chunk

DISCOVERY_PORT = 22226
"""UDP port on which QTM answers discovery requests."""
_TRIES = 3
"""Number of discovery requests sent to each network, because datagrams may be lost."""


class _Announcements(asyncio.DatagramProtocol):
    """Replies received at one local address, by the address of the server."""

    def __init__(self) -> None:
        self.servers: dict[str, qtm.ServerAnnouncement] = {}

    @override
    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        found = qtm.decode_announcement(data)
        if isinstance(found, qtm.ServerAnnouncement):
            self.servers[addr[0]] = found

    @override
    def error_received(self, exc: Exception) -> None:
        """Ignore ICMP errors such as "port unreachable", because such a host does not answer."""


async def find_servers(
    hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
) -> list[FoundServer]:
    """Return the QTM servers that answer; see `ServerSearch.find_servers`."""
    tables = []
    for host in hosts:
        settings = QtmSettings(
            driver="qtm", server=host, command_port=port or PORT, transport="tcp"
        )
        try:
            tables.append((settings, await find_route("QTM", settings)))
        except DeviceLostError as error:
            raise OSError(str(error)) from None

    named = [_ask_host(*table, wait_s) for table in tables]
    networks = broadcast_networks() if broadcast else []
    return await gather_servers(named, [_ask_network(*each, wait_s) for each in networks])


async def _ask_host(settings: QtmSettings, route: Route, wait_s: float) -> list[FoundServer]:
    """Return the server at an address with the names in its settings; empty without an answer."""
    described = asyncio.Event()
    found: list[qtm.QtmSettingsXml] = []

    def take(chunk: Chunk) -> None:
        message = qtm.decode(chunk.data)
        if isinstance(message, qtm.SettingsReply):
            settings_xml = qtm.parse_settings(message.xml)
            found.extend([settings_xml] if settings_xml is not None else [])
            described.set()

    session = QtmSession(settings, route, take)
    await run_until(session.run(), described, wait_s)
    if session.version is None:
        return []

    layout = bind_settings(found[-1], {}, {}).columns.layout if found else None
    return [
        FoundServer(
            driver="qtm",
            server=route.host,
            port=settings.command_port,
            interface=route.local,
            application="QTM",
            version="",
            protocol=f"QTM RT {session.version}",
            transport="unicast",
            bodies=() if layout is None else layout.bodies,
            markers=() if layout is None else layout.markers,
        )
    ]


async def _ask_network(local: str, address: str, wait_s: float) -> list[FoundServer]:
    """Return the servers that answer in the network of one card."""
    loop = asyncio.get_running_loop()
    transport, answers = await loop.create_datagram_endpoint(
        _Announcements, local_addr=(local, 0), allow_broadcast=True
    )
    try:
        port = transport.get_extra_info("sockname")[1]
        for _ in range(_TRIES):
            transport.sendto(qtm.encode(qtm.Discover(port)), (address, DISCOVERY_PORT))
            await asyncio.sleep(wait_s / _TRIES)
    finally:
        transport.close()

    found = []
    for host, announced in answers.servers.items():
        # ``HOST, QTM 2.5 (build 568), 5 cameras``
        parts = [part.strip() for part in announced.text.split(",")]
        version = next((part for part in parts if part.startswith("QTM")), "QTM")
        found.append(
            FoundServer(
                driver="qtm",
                server=host,
                port=announced.base_port + 1,
                interface=local,
                application="QTM",
                version=version.removeprefix("QTM").strip(),
                protocol="QTM RT",
                transport="unicast",
            )
        )
    return found
