"""Driver of motion-capture systems with a VRPN server.

`VrpnDecoder` is pure: it uses no clock and no I/O. `VrpnMocap.run` connects and emits complete
messages in the order of arrival, so that a replay has the same input as the live decoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import ServerOutput, find_route
from jointfit_drivers.vrpn._decoder import VrpnDecoder
from jointfit_drivers.vrpn._server_search import diagnose, find_servers
from jointfit_drivers.vrpn._session import VrpnSession
from jointfit_drivers.vrpn._settings import VrpnSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class VrpnMocap:
    """One VRPN server: rigid bodies, stamped by the server's clock when a message is created."""

    Settings: ClassVar[type[VrpnSettings]] = VrpnSettings
    wire: ClassVar[Wire] = "stream"
    least_delay_ms: ClassVar[tuple[float, float]] = (15.0, 10.0)
    """Mean and standard deviation of the delay from exposure to arrival, ms. The stamp is the time
    of the message, not of the exposure."""

    find_servers = staticmethod(find_servers)
    diagnose = staticmethod(diagnose)

    def __init__(self, settings: VrpnSettings) -> None:
        self._settings = settings
        self._output = ServerOutput()

    def decoder(self) -> VrpnDecoder:
        """Return the decoder from messages to optical frames in SI units."""
        return VrpnDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, has no listening server, or closes the connection.
            Or the server sends no pose for ``silence_s``. A retry may succeed.
        DeviceMisconfiguredError
            The host is not a VRPN server, its major version differs, or the network card does not
            exist.
        """
        route = await find_route("VRPN", self._settings)
        await VrpnSession(self._settings, route, emit, self._output).run()
