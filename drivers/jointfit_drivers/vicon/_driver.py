"""Driver of Vicon Nexus, Tracker, Shogun, Evoke and Blade by the DataStream, over TCP.

`ViconDecoder` is the pure part. `ViconMocap.run` connects and emits every packet of the server, so
that a replay has the same input as the live decoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.motion_capture import find_route
from jointfit_drivers.vicon._decoder import ViconDecoder
from jointfit_drivers.vicon._diagnosis import diagnose, find_servers
from jointfit_drivers.vicon._session import ViconSession
from jointfit_drivers.vicon._settings import ViconSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.device_search import Finding, FoundServer
    from jointfit_daemon.driver import Emit, Wire


class ViconMocap:
    """One DataStream server: labeled markers, props and segments of subjects."""

    Settings: ClassVar[type[ViconSettings]] = ViconSettings
    wire: ClassVar[Wire] = "datagram"
    """A chunk is one packet of the protocol."""

    def __init__(self, settings: ViconSettings) -> None:
        self._settings = settings
        self._silent = False

    def decoder(self) -> ViconDecoder:
        """Return the decoder from packets to optical frames in SI units."""
        return ViconDecoder(self._settings)

    @classmethod
    async def find_servers(
        cls, hosts: Sequence[str], *, broadcast: bool, port: int | None, wait_s: float
    ) -> list[FoundServer]:
        """Return the DataStream servers that answer; see `jointfit_daemon.device_search`."""
        return await find_servers(hosts, broadcast=broadcast, port=port, wait_s=wait_s)

    @classmethod
    async def diagnose(cls, settings: ViconSettings, wait_s: float) -> list[Finding]:
        """Return the causes of missing frames; see `jointfit_daemon.device_search`."""
        return await diagnose(settings, wait_s)

    async def run(self, emit: Emit) -> None:
        """Connect to the server and read until cancelled.

        Raises
        ------
        DeviceLostError
            The host is unknown, does not answer, has no listening server, or sends no frame for
            ``silence_s``. A retry may succeed.
        DeviceMisconfiguredError
            The host is no DataStream server, offers no segments and markers, or the network card
            is unknown.
        """
        route = await find_route("Vicon", self._settings)
        session = ViconSession(self._settings, route, emit, after_silence=self._silent)
        try:
            await session.run()
        finally:
            self._silent = session.silent
