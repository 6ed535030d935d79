"""Driver of LP-Research LPMS sensors that use LP-BUS on a serial port or USB.

`LpmsDecoder` is pure: it uses no clock and no I/O. `LpmsImu.run` opens the port, starts the stream
of the sensor, and reads until it is cancelled. The decoder receives only the chunks that `run`
emits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.lpms._decoder import LpmsDecoder
from jointfit_drivers.lpms._handshake import LINE_SPEEDS, LpmsHandshake
from jointfit_drivers.lpms._settings import LpmsSettings
from jointfit_drivers.serial_reception import SerialReception

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class LpmsImu:
    """One LPMS sensor, which sends orientation and device time in ticks of its filter."""

    Settings: ClassVar[type[LpmsSettings]] = LpmsSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: LpmsSettings) -> None:
        self._settings = settings
        self._reception = SerialReception(settings)

    def decoder(self) -> LpmsDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        return LpmsDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Open the port, start the stream of the sensor, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            `port` is not a serial port, no LPMS sensor answers, the sensor has another speed,
            generation or address, or it does not accept the settings.
        """
        settings = self._settings
        await self._reception.run(
            emit,
            lambda port, hunt: LpmsHandshake(port, emit, settings, hunt=hunt).ensure_streaming(),
        )
