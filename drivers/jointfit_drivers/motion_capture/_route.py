"""Network route to a server: its address, and the network card of this host."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ports.udp_socket import local_address

if TYPE_CHECKING:
    from jointfit_drivers.motion_capture._settings import ServerSettings


class Route(NamedTuple):
    """Numeric addresses of a server and of this host's network card."""

    host: str
    local: str


async def host_address(name: str) -> str:
    """Return the IPv4 address of a host.

    Raises
    ------
    OSError
        The name cannot be resolved.
    """
    try:
        found = await asyncio.get_running_loop().getaddrinfo(name, None, family=socket.AF_INET)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise OSError(
            f"{name}: no such host ({why}): set the address of the server, such as 192.168.1.20"
        ) from None
    return str(found[0][4][0])


async def find_route(kind: str, settings: ServerSettings) -> Route:
    """Return the route to the server of a ``[mocap]`` table.

    Parameters
    ----------
    kind : str
        Name of the device family for error messages, such as ``NatNet``.
    settings : ServerSettings
        The ``[mocap]`` table.

    Raises
    ------
    DeviceLostError
        The host name is unknown, or there is no route to the host.
    DeviceMisconfiguredError
        The configured network card does not exist.
    """
    name, interface = settings.server, settings.interface
    try:
        host = await host_address(name)
    except OSError as error:
        raise DeviceLostError(
            f"{kind} server {name}: no such host: correct server, or enter its IPv4 address"
        ) from error

    try:
        return Route(host, local_address(host, interface))
    except OSError as error:
        if interface is None:
            raise DeviceLostError(
                f"{kind} server {host}: {error.strerror or error}: check network cable, "
                "address of the network card, and server"
            ) from error
        raise DeviceMisconfiguredError(
            f"mocap.interface = {interface!r}: no network card with this name or IPv4 address: "
            "correct the key (`ip address` lists the cards), or remove the key"
        ) from error
