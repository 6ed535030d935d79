"""Search for NatNet servers: sends DISCOVERY to a network, and CONNECT to a named host.

The model of a named host is requested as well, because it contains the names of rigid bodies and
markers. Servers in unicast mode send frames after CONNECT, until DISCONNECT is sent.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.device_search import FoundServer
from jointfit_drivers.motion_capture import gather_servers, host_address
from jointfit_drivers.natnet._binding import bind_model
from jointfit_drivers.ports.network_cards import broadcast_networks
from jointfit_drivers.ports.udp_socket import local_address
from jointfit_protocols import natnet
from jointfit_protocols.natnet import NatNetMessageId

if TYPE_CHECKING:
    from collections.abc import Sequence

COMMAND_PORT = 1510
"""Default command port of Motive."""
_TRIES = 3
"""Number of times that a request is sent, because datagrams may be lost."""
_REQUEST = natnet.Connect(264, "jointfitd", (1, 0, 0, 0), (3, 0, 0, 0))


class _Answers(asyncio.DatagramProtocol):
    """Answers received at one local address, by server."""

    def __init__(self) -> None:
        self.servers: dict[tuple[str, int], natnet.ServerInfo] = {}
        self.models: dict[tuple[str, int], natnet.ModelDefinition] = {}
        self.changed = asyncio.Event()

    @override
    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        info = self.servers.get(addr)
        message = natnet.decode(data, (3, 0) if info is None else info.bitstream)
        if isinstance(message, natnet.ServerInfo):
            self.servers[addr] = message
            self.changed.set()
        elif isinstance(message, natnet.ModelDefinition) and info is not None:
            self.models[addr] = message
            self.changed.set()

    @override
    def error_received(self, exc: Exception) -> None:
        """Ignore refusals, because a host that refuses is no server."""


async def find_servers(
    hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
) -> list[FoundServer]:
    """Return the NatNet servers that answer; see `ServerSearch.find_servers`."""
    addresses = [await host_address(host) for host in hosts]
    targets = [(local_address(address, None), address) for address in addresses]

    port = port or COMMAND_PORT
    named = [_ask_host(*target, port, wait_s) for target in targets]
    networks = broadcast_networks() if broadcast else []
    return await gather_servers(named, [_ask_network(*each, port, wait_s) for each in networks])


async def _ask_host(local: str, address: str, port: int, wait_s: float) -> list[FoundServer]:
    """Return the server at an address with the names in its model; empty if it does not answer."""
    loop = asyncio.get_running_loop()
    transport, answers = await loop.create_datagram_endpoint(_Answers, local_addr=(local, 0))
    server = (address, port)

    try:
        for request, replies in (
            (_REQUEST, answers.servers),
            (natnet.Bare(NatNetMessageId.REQUEST_MODELDEF), answers.models),
        ):
            for _ in range(_TRIES):
                transport.sendto(natnet.encode(request), server)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(wait_s / _TRIES):
                        while server not in replies:
                            answers.changed.clear()
                            await answers.changed.wait()
                    break
        transport.sendto(natnet.encode(natnet.Bare(NatNetMessageId.DISCONNECT)), server)
    finally:
        transport.close()
    return _found_servers(local, answers)


async def _ask_network(local: str, address: str, port: int, wait_s: float) -> list[FoundServer]:
    """Return the servers that answer in the network of one card."""
    loop = asyncio.get_running_loop()
    transport, answers = await loop.create_datagram_endpoint(
        _Answers, local_addr=(local, 0), allow_broadcast=True
    )
    try:
        for _ in range(_TRIES):
            transport.sendto(natnet.encode(natnet.Discovery(_REQUEST)), (address, port))
            await asyncio.sleep(wait_s / _TRIES)
    finally:
        transport.close()
    return _found_servers(local, answers)


def _found_servers(local: str, answers: _Answers) -> list[FoundServer]:
    found = []
    for address, info in answers.servers.items():
        model = answers.models.get(address)
        layout = None if model is None else bind_model(model, {}, {}).columns.layout
        found.append(
            FoundServer(
                driver="natnet",
                server=address[0],
                port=address[1],
                interface=local,
                application=info.application,
                version=".".join(map(str, info.application_version)),
                protocol="NatNet {}.{}".format(*info.bitstream),
                transport="multicast" if info.multicast else "unicast",
                bodies=() if layout is None else layout.bodies,
                markers=() if layout is None else layout.markers,
            )
        )
    return found
