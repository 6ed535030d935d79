"""Driver of Vicon Nexus, Tracker, Shogun, Evoke and Blade, by the protocol DataStream over TCP.

`ViconDecoder` is pure: it uses no clock and no I/O. `ViconMocap.run` connects and emits every
packet of the server, so that a replay has the same input as the live decoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import ServerOutput, find_route
from jointfit_drivers.vicon._decoder import ViconDecoder
from jointfit_drivers.vicon._diagnosis import diagnose, find_servers
from jointfit_drivers.vicon._session import ViconSession
from jointfit_drivers.vicon._settings import ViconSettings
from jointfit_protocols.vicon import ViconStream

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class ViconMocap:
    """One DataStream server: labeled markers, props and segments of subjects."""

    Settings: ClassVar[type[ViconSettings]] = ViconSettings
    wire: ClassVar[Wire] = "datagram"
    """A chunk is one packet of the protocol."""

    packet_stream = ViconStream
    """Class that splits the bytes of a recorded connection into packets."""

    find_servers = staticmethod(find_servers)
    diagnose = staticmethod(diagnose)

    def __init__(self, settings: ViconSettings) -> None:
        self._settings = settings
        self._output = ServerOutput()

    def decoder(self) -> ViconDecoder:
        """Return the decoder from packets to optical frames in SI units."""
        return ViconDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, or has no listening server. Or the server sends no
            frame for ``silence_s``. A retry may succeed.
        DeviceMisconfiguredError
            The host is not a DataStream server, offers no segments and markers, or the network card
            does not exist.
        """
        route = await find_route("Vicon", self._settings)
        await ViconSession(self._settings, route, emit, self._output).run()
