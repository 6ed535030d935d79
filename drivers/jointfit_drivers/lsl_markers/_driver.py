"""Driver of motion capture that arrives as a stream of the Lab Streaming Layer.

`LslMarkersDecoder` is pure. `LslMarkersMocap.run` searches for the stream. It then emits the
description, the samples and the clock comparisons as chunks, so that the decoder has the same input
in a replay.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.lsl_markers._decoder import LslMarkersDecoder
from jointfit_drivers.lsl_markers._server_search import diagnose, find_servers
from jointfit_drivers.lsl_markers._session import LslSession
from jointfit_drivers.lsl_markers._settings import LslMarkersSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class LslMarkersMocap:
    """One stream of markers or rigid bodies, usually stamped by the LSL clock of the sending PC."""

    Settings: ClassVar[type[LslMarkersSettings]] = LslMarkersSettings
    wire: ClassVar[Wire] = "datagram"
    least_delay_ms: ClassVar[tuple[float, float]] = (15.0, 10.0)
    """Mean and standard deviation of the delay from exposure to stamp, ms. Most programs stamp a
    sample when they send it."""

    find_servers = staticmethod(find_servers)
    diagnose = staticmethod(diagnose)

    def __init__(self, settings: LslMarkersSettings) -> None:
        self._settings = settings

    def decoder(self) -> LslMarkersDecoder:
        """Return the decoder from chunks to optical frames in SI units."""
        return LslMarkersDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Search for the stream, and read until cancelled.

        Raises
        ------
        DeviceLostError
            No stream fits, or the sender ended the stream, does not answer, or sends no sample for
            ``silence_s``. A retry may succeed.
        DeviceMisconfiguredError
            pylsl is not installed, several streams fit, or the stream contains no numbers.
        """
        await LslSession(self._settings, emit).run()
