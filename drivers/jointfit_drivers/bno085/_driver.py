"""Driver of Bosch / CEVA BNO085 and BNO086 on a serial port.

`RvcDecoder` and `ShtpDecoder` are pure: they use no clock and no I/O. `Bno085Imu.run` opens the
port, starts the output of the device, and reads until it is cancelled. The decoder receives only
the chunks that `run` emits. The mode of the device determines the speed of the port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.bno085._handshake import ensure_rvc, ensure_shtp
from jointfit_drivers.bno085._rvc_decoder import RvcDecoder
from jointfit_drivers.bno085._settings import RVC_BAUD, SHTP_BAUD, Bno085Settings
from jointfit_drivers.bno085._shtp_decoder import ShtpDecoder
from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.ports.serial_port import SerialPort

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class Bno085Imu:
    """One BNO085 or BNO086, which sends orientations with an 8-bit number and no device time."""

    Settings: ClassVar[type[Bno085Settings]] = Bno085Settings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = (RVC_BAUD, SHTP_BAUD)

    def __init__(self, settings: Bno085Settings) -> None:
        self._settings = settings

    def decoder(self) -> RvcDecoder | ShtpDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        if settings.baud == RVC_BAUD:
            return RvcDecoder(settings.line_baud, settings.euler)
        raw = None
        if settings.orientation == "gateway":
            raw = RawSamples.of(settings)
        return ShtpDecoder(settings.line_baud, raw, settings.reports[0])

    async def run(self, emit: Emit) -> None:
        """Open the port, make the device send, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            `port` is not a serial port, or the device is not a BNO085, is in another mode, or does
            not accept the rate.
        """
        settings = self._settings
        ensure = ensure_rvc if settings.baud == RVC_BAUD else ensure_shtp
        with SerialPort(settings.port, settings.baud) as port:
            await ensure(port, emit, settings)
            await port.pump(emit, settings.lost_after_s)
