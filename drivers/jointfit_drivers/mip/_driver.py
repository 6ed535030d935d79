"""Driver of MicroStrain IMUs that use MIP on a serial port or USB.

`MipDecoder` is pure: it uses no clock and no I/O. `MipImu.run` opens the port, starts the stream of
the device, and reads until it is cancelled. The decoder receives only the chunks that `run` emits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.mip._decoder import MipDecoder
from jointfit_drivers.mip._handshake import LINE_SPEEDS, MipHandshake
from jointfit_drivers.mip._settings import MipSettings
from jointfit_drivers.serial_reception import SerialReception

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class MipImu:
    """One MIP device, which sends orientation and device time in ns."""

    Settings: ClassVar[type[MipSettings]] = MipSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: MipSettings) -> None:
        self._settings = settings
        self._reception = SerialReception(settings)

    def decoder(self) -> MipDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        return MipDecoder(settings.line_baud, settings.required, RawSamples.maker(settings))

    async def run(self, emit: Emit) -> None:
        """Open the port, make the device stream, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            `port` is not a serial port, no MIP device answers, or the device uses another speed or
            cannot send the orientation at this rate.
        """
        settings = self._settings
        await self._reception.run(
            emit,
            lambda port, hunt: MipHandshake(port, emit, settings, hunt=hunt).ensure_streaming(),
        )
