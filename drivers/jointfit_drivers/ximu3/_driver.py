"""Driver of x-io x-IMU3 on a serial port or USB, and of boards that send its messages.

`XImu3Decoder` is pure: it uses no clock and no I/O. `XImu3Imu.run` opens the port, checks the
settings of the device and reads until cancelled. The decoder receives only the chunks that `run`
emits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.serial_reception import SerialReception
from jointfit_drivers.ximu3._decoder import XImu3Decoder
from jointfit_drivers.ximu3._handshake import LINE_SPEEDS, XImu3Handshake
from jointfit_drivers.ximu3._passive_check import ensure_expected_messages
from jointfit_drivers.ximu3._settings import XImu3Settings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire
    from jointfit_drivers.ports.serial_port import SerialPort


class XImu3Imu:
    """One x-IMU3, which sends orientation and device time in microseconds."""

    Settings: ClassVar[type[XImu3Settings]] = XImu3Settings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: XImu3Settings) -> None:
        self._settings = settings
        self._reception = SerialReception(settings)

    def decoder(self) -> XImu3Decoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        return XImu3Decoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Open the port, check the device, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            The file is not a serial port, or no x-IMU3 answers. Or the device uses another speed,
            or its settings differ while ``persist`` is false. Or, with ``passive``, the device
            sends only other messages.
        """
        settings = self._settings

        async def start(port: SerialPort, hunt: bool) -> None:
            if settings.passive:
                port.flush_input()
                await ensure_expected_messages(port, emit, settings, settings.lost_after_s)
            else:
                await XImu3Handshake(port, emit, settings, hunt=hunt).ensure_configured()

        await self._reception.run(emit, start)
