"""Driver of Qualisys Track Manager by its real-time protocol, over TCP and UDP.

`QtmDecoder` is the pure part. `QtmMocap.run` connects and emits every packet of the server, answers
included, so that a replay has the same input as the live decoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import find_route
from jointfit_drivers.qtm._decoder import QtmDecoder
from jointfit_drivers.qtm._diagnosis import diagnose
from jointfit_drivers.qtm._server_search import find_servers
from jointfit_drivers.qtm._session import QtmSession
from jointfit_drivers.qtm._settings import QtmSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.device_search import Finding, FoundServer
    from jointfit_daemon.driver import Emit, Wire


class QtmMocap:
    """One QTM server: labeled markers, 6DOF bodies and segments of skeletons."""

    Settings: ClassVar[type[QtmSettings]] = QtmSettings
    wire: ClassVar[Wire] = "datagram"
    """A chunk is one packet of the protocol, over TCP as over UDP."""

    def __init__(self, settings: QtmSettings) -> None:
        self._settings = settings
        self._silent = False

    def decoder(self) -> QtmDecoder:
        """Return the decoder from packets to optical frames in SI units."""
        return QtmDecoder(self._settings)

    @classmethod
    async def find_servers(
        cls, hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
    ) -> list[FoundServer]:
        """Return the QTM servers that answer; see `jointfit_daemon.device_search`."""
        return await find_servers(hosts, broadcast=broadcast, port=port, wait_s=wait_s)

    @classmethod
    async def diagnose(cls, settings: QtmSettings, wait_s: float) -> list[Finding]:
        """Return the causes of missing frames; see `jointfit_daemon.device_search`."""
        return await diagnose(settings, wait_s)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, has no listening server, has too many clients, or
            sends no frame for ``silence_s`` during a measurement. A retry may succeed.
        DeviceMisconfiguredError
            The host is no QTM server, its port is big-endian, its version is not supported, or the
            network card is unknown.
        """
        route = await find_route("QTM", self._settings)
        session = QtmSession(self._settings, route, emit, after_silence=self._silent)
        try:
            await session.run()
        finally:
            self._silent = session.silent
