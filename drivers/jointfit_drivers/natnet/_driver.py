"""Driver of OptiTrack Motive and other servers of NatNet 2.5 to 4.x, over UDP.

`NatNetDecoder` is pure: it uses no clock and no I/O. `NatNetMocap.run` connects and emits every
accepted datagram of the server. This includes the answers of the handshake, so the decoder has the
same input in a replay.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import ServerOutput, find_route
from jointfit_drivers.natnet._decoder import NatNetDecoder
from jointfit_drivers.natnet._diagnosis import diagnose
from jointfit_drivers.natnet._server_search import find_servers
from jointfit_drivers.natnet._session import NatNetSession
from jointfit_drivers.natnet._settings import NatNetSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class NatNetMocap:
    """One NatNet server: labeled markers and rigid bodies, stamped by the server's clock."""

    Settings: ClassVar[type[NatNetSettings]] = NatNetSettings
    wire: ClassVar[Wire] = "datagram"

    find_servers = staticmethod(find_servers)
    diagnose = staticmethod(diagnose)

    def __init__(self, settings: NatNetSettings) -> None:
        self._settings = settings
        self._output = ServerOutput()

    def decoder(self) -> NatNetDecoder:
        """Return the decoder from datagrams to optical frames in SI units."""
        return NatNetDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, or has no listening server. Or the server sends no
            frame for ``silence_s``, or was replaced by another server. A retry may succeed.
        DeviceMisconfiguredError
            The host is not a NatNet server, its bitstream is not supported, or the network card
            does not exist.
        """
        route = await find_route("NatNet", self._settings)
        await NatNetSession(self._settings, route, emit, self._output).run()
