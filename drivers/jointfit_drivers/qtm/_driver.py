"""Driver of Qualisys Track Manager by its real-time protocol, over TCP and UDP.

`QtmDecoder` is pure: it uses no clock and no I/O. `QtmMocap.run` connects and emits every packet of
the server. This includes the answers, so a replay has the same input as the live decoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import ServerOutput, find_route
from jointfit_drivers.qtm._decoder import QtmDecoder
from jointfit_drivers.qtm._diagnosis import diagnose
from jointfit_drivers.qtm._server_search import find_servers
from jointfit_drivers.qtm._session import QtmSession
from jointfit_drivers.qtm._settings import QtmSettings
from jointfit_protocols.qtm import QtmStream

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class QtmMocap:
    """One QTM server: labeled markers, 6DOF bodies and segments of skeletons."""

    Settings: ClassVar[type[QtmSettings]] = QtmSettings
    wire: ClassVar[Wire] = "datagram"
    """A chunk is one packet of the protocol, both over TCP and over UDP."""

    packet_stream = QtmStream
    """Class that splits the bytes of a recorded connection into packets."""

    find_servers = staticmethod(find_servers)
    diagnose = staticmethod(diagnose)

    def __init__(self, settings: QtmSettings) -> None:
        self._settings = settings
        self._output = ServerOutput()

    def decoder(self) -> QtmDecoder:
        """Return the decoder from packets to optical frames in SI units."""
        return QtmDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, has no listening server, or has too many clients.
            Or the server sends no frame for ``silence_s`` during a measurement. A retry may
            succeed.
        DeviceMisconfiguredError
            The host is not a QTM server, its port is big-endian, its version is not supported, or
            the network card does not exist.
        """
        route = await find_route("QTM", self._settings)
        await QtmSession(self._settings, route, emit, self._output).run()
