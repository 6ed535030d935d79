"""Driver of OptiTrack Motive and other servers of NatNet 2.5 to 4.x, over UDP.

`NatNetDecoder` is the pure part. `NatNetMocap.run` connects and emits every accepted datagram
of the server, answers of the handshake included, so that a replay has the same input as the
live decoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import find_route
from jointfit_drivers.natnet._decoder import NatNetDecoder
from jointfit_drivers.natnet._diagnosis import diagnose
from jointfit_drivers.natnet._server_search import find_servers
from jointfit_drivers.natnet._session import NatNetSession
from jointfit_drivers.natnet._settings import NatNetSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.device_search import Finding, FoundServer
    from jointfit_daemon.driver import Emit, Wire


class NatNetMocap:
    """One NatNet server: labeled markers and rigid bodies, stamped by its own clock."""

    Settings: ClassVar[type[NatNetSettings]] = NatNetSettings
    wire: ClassVar[Wire] = "datagram"

    def __init__(self, settings: NatNetSettings) -> None:
        self._settings = settings
        self._silent = False

    def decoder(self) -> NatNetDecoder:
        """Return the decoder from datagrams to optical frames in SI units."""
        return NatNetDecoder(self._settings)

    @classmethod
    async def find_servers(
        cls, hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
    ) -> list[FoundServer]:
        """Return the NatNet servers that answer; see `jointfit_daemon.device_search`."""
        return await find_servers(hosts, broadcast=broadcast, port=port, wait_s=wait_s)

    @classmethod
    async def diagnose(cls, settings: NatNetSettings, wait_s: float) -> list[Finding]:
        """Return the causes of missing frames; see `jointfit_daemon.device_search`."""
        return await diagnose(settings, wait_s)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, has no listening server, sends no frame for
            ``silence_s``, or another server has taken its place. A retry may succeed.
        DeviceMisconfiguredError
            The host is no NatNet server, its bitstream is not supported, or the network card is
            unknown.
        """
        host, local = await find_route("NatNet", self._settings)
        session = NatNetSession(self._settings, host, local, emit, after_silence=self._silent)
        try:
            await session.run()
        finally:
            self._silent = session.silent
