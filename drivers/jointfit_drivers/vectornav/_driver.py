"""Driver of VectorNav IMUs on a serial port or USB.

`VectorNavDecoder` is pure: it uses no clock and no I/O. `VectorNavImu.run` opens the port, starts
the stream of the device, and reads until cancelled. The decoder receives only the chunks that `run`
emits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.serial_reception import SerialReception
from jointfit_drivers.vectornav._decoder import VectorNavDecoder
from jointfit_drivers.vectornav._handshake import LINE_SPEEDS, VectorNavHandshake
from jointfit_drivers.vectornav._settings import VectorNavSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class VectorNavImu:
    """One VectorNav device, which sends orientation and device time in ns."""

    Settings: ClassVar[type[VectorNavSettings]] = VectorNavSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: VectorNavSettings) -> None:
        self._settings = settings
        self._reception = SerialReception(settings)

    def decoder(self) -> VectorNavDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        inverse = settings.direction == "world_to_sensor"
        return VectorNavDecoder(
            settings.line_baud,
            world_to_sensor=inverse,
            make_raw=RawSamples.maker(settings),
            rate_hz=settings.rate_hz,
            output=settings.output,
        )

    async def run(self, emit: Emit) -> None:
        """Open the port, make the device stream, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            The file is not a serial port, or no VectorNav device answers. Or the device uses
            another speed, or cannot send the orientation at this rate.
        """
        settings = self._settings
        await self._reception.run(
            emit,
            lambda port, hunt: VectorNavHandshake(
                port, emit, settings, hunt=hunt
            ).ensure_streaming(),
        )
