"""OptiTrack Motive, and whatever else speaks NatNet 3 or 4 over UDP.

Law: two halves. `NatNetDecoder` is pure; `run` connects and hands on every datagram of the server,
answers to the handshake included, so that a replay of the chunks sees all that was seen live.
"""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, ClassVar

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.natnet._decoder import NatNetDecoder
from jointfit_drivers.natnet._session import Session
from jointfit_drivers.natnet._settings import NatNetSettings
from jointfit_drivers.ports.udp_socket import local_address

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class NatNetMocap:
    """One NatNet server: labeled markers and rigid bodies, stamped by its own clock."""

    Settings: ClassVar[type[NatNetSettings]] = NatNetSettings
    wire: ClassVar[Wire] = "datagram"

    def __init__(self, settings: NatNetSettings) -> None:
        self._settings = settings

    def decoder(self) -> NatNetDecoder:
        """Return the pure half: datagrams in, optical frames in SI out."""
        return NatNetDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            No such host, no answer, nobody listening, no frame for ``silence_s``, another server
            in its place; worth another try.
        DeviceMisconfiguredError
            Not a NatNet server, a bitstream that cannot be read, no such network card.
        """
        host = await self._resolve()
        await Session(self._settings, host, self._local(host), emit).run()

    async def _resolve(self) -> str:
        """Return the numeric address of the server."""
        name = self._settings.server
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(name, None, family=socket.AF_INET)
        except (OSError, UnicodeError) as error:
            raise DeviceLostError(f"NatNet server {name}: no such host: {error}") from error
        return str(found[0][4][0])

    def _local(self, host: str) -> str:
        """Return the address of the network card to use."""
        interface = self._settings.interface
        try:
            return local_address(host, interface)
        except OSError as error:
            if interface is None:
                raise DeviceLostError(f"NatNet server {host}: {error.strerror or error}") from error
            raise DeviceMisconfiguredError(
                f"mocap.interface = {interface!r}: no such network card with an IPv4 address"
            ) from error
