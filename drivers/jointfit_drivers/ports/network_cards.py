"""Network cards of this host and their IPv4 addresses, requested from the kernel.

The requests return only the first address of a card.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from ipaddress import IPv4Address, IPv4Network
from typing import NamedTuple

_SIOCGIFFLAGS, _SIOCGIFADDR, _SIOCGIFBRDADDR, _SIOCGIFNETMASK = 0x8913, 0x8915, 0x8919, 0x891B
_IFF_UP, _IFF_BROADCAST, _IFF_LOOPBACK = 0x1, 0x2, 0x8
_NAME_BYTES = 15
_ADDRESS = slice(20, 24)
"""Bytes of the IPv4 address in ``struct ifreq``, after name, family and port."""


class NetworkCard(NamedTuple):
    """One network card that is up and has an IPv4 address."""

    name: str
    address: str
    network: IPv4Network
    broadcast: str | None
    """Broadcast address of the network; None if there is none, for example for loopback."""
    loopback: bool

    def reaches(self, host: str) -> bool:
        """Return whether `host` is in the network of this card, without a router between them."""
        return IPv4Address(host) in self.network


def network_cards() -> list[NetworkCard]:
    """Return the network cards of this host in the order of the kernel."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:_NAME_BYTES])
            try:
                raw = fcntl.ioctl(control, _SIOCGIFFLAGS, request)
                (flags,) = struct.unpack_from("H", raw, 16)
                address = _read(control, _SIOCGIFADDR, request)
                mask = _read(control, _SIOCGIFNETMASK, request)
                reply = _read(control, _SIOCGIFBRDADDR, request)
            except OSError:  # no IPv4 address
                continue
            if flags & _IFF_UP:
                network = IPv4Network((address, mask), strict=False)
                broadcast = reply if flags & _IFF_BROADCAST else None
                loopback = bool(flags & _IFF_LOOPBACK)
                found.append(NetworkCard(name, address, network, broadcast, loopback))
    return found


def _read(control: socket.socket, number: int, request: bytes) -> str:
    return socket.inet_ntoa(fcntl.ioctl(control, number, request)[_ADDRESS])


def broadcast_networks() -> list[tuple[str, str]]:
    """Return this host's address and the broadcast address of each network, loopback first."""
    loopback = "127.0.0.1"
    cards = [(card.address, card.broadcast) for card in network_cards()]
    return [(loopback, loopback), *((local, to) for local, to in cards if to is not None)]
