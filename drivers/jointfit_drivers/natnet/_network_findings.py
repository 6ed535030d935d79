"""Findings about the network card for a NatNet server, and search for its multicast frames."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding
from jointfit_drivers.motion_capture import CHECK
from jointfit_drivers.natnet._bitstream import FRAME_START
from jointfit_drivers.ports.udp_socket import UdpSocket

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_drivers.ports.network_cards import NetworkCard


def card_findings(
    name: str,
    host: str,
    local: str,
    routed: str | None,
    cards: Sequence[NetworkCard],
    *,
    chosen: bool = False,
    arrived: bool = False,
) -> list[Finding]:
    """Return the faults in the choice of the network card; the function is pure.

    Parameters
    ----------
    name
        Name of the server as written in rig.toml.
    host, local
        Numeric addresses of the server and of the network card in use.
    routed
        Address of the card that the kernel uses for the server; None if there is no route.
    cards
        Network cards of this host.
    chosen
        Whether rig.toml selects the card. In this case several cards are no fault.
    arrived
        Whether frames arrive. In this case several cards are only a risk.
    """
    names = {card.address: card.name for card in cards}
    used = next((card for card in cards if card.address == local), None)
    reaching = [card for card in cards if card.reaches(host)]

    if routed is not None and routed != local:
        return [
            Finding(
                CHECK, name, "error",
                f"wrong interface: frames are expected at {names.get(local, local)} ({local}), but "
                f"the route to {host} leaves by {names.get(routed, routed)} ({routed})",
                f'set interface = "{routed}" in [mocap], or remove the key',
            )
        ]  # fmt: skip
    if used is not None and not used.loopback and not reaching:
        return [
            Finding(
                CHECK, name, "warning",
                f"another subnet: {host} is not in {used.network} of {used.name}; routers do not "
                "pass on multicast and broadcasts",
                f"give the server an address in {used.network}, or switch Motive to unicast",
            )
        ]  # fmt: skip
    if len(reaching) > 1 and not chosen:
        listed = " and ".join(f"{card.name} ({card.address})" for card in reaching)
        return [
            Finding(
                CHECK, name, "note" if arrived else "warning",
                f"several interfaces reach {host}: {listed}; multicast frames may arrive at any of "
                "them",
                f'set interface = "{local}" in [mocap], or disconnect a card: '
                f"sudo ip link set {reaching[-1].name} down",
            )
        ]  # fmt: skip
    return []


async def multicast_arrivals(
    group: str, port: int, host: str, cards: Sequence[NetworkCard], wait_s: float
) -> dict[str, int]:
    """Return how many frames of a multicast group arrive at each card, by the card's address."""
    counts = {card.address: 0 for card in cards}
    with contextlib.ExitStack() as stack:
        opened = []
        for card in cards:
            with contextlib.suppress(OSError):  # a card without multicast
                receiver = UdpSocket.in_group(group, port, card.address, sender=host)
                opened.append((card.address, stack.enter_context(contextlib.closing(receiver))))
        await asyncio.sleep(wait_s)
        for address, receiver in opened:
            while arrivals := receiver.receive():
                counts[address] += sum(each.data.startswith(FRAME_START) for each in arrivals)
    return counts
