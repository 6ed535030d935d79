"""Driver of WitMotion IMUs (WT901, JY901, HWT905 and relatives) on a serial port.

`WitMotionDecoder` is pure: it uses no clock and no I/O. `WitMotionImu.run` opens the port, makes
the device send the required frames and reads until cancelled. The decoder receives only the chunks
that `run` emits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.witmotion._decoder import WitMotionDecoder
from jointfit_drivers.witmotion._handshake import LINE_SPEEDS, WitMotionHandshake
from jointfit_drivers.witmotion._settings import WitMotionSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class WitMotionImu:
    """One WitMotion device. Samples have the time of arrival or the device's calendar time."""

    Settings: ClassVar[type[WitMotionSettings]] = WitMotionSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: WitMotionSettings) -> None:
        self._settings = settings

    def decoder(self) -> WitMotionDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        raw = None
        if settings.orientation == "gateway":
            raw = RawSamples.of(settings)
        return WitMotionDecoder(
            settings.line_baud,
            settings.world,
            inverse=settings.direction == "world_to_sensor",
            device_time=settings.device_time,
            raw=raw,
        )

    async def run(self, emit: Emit) -> None:
        """Open the port, make the device send the required frames, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            The file is not a serial port, or no WitMotion device answers. Or the device uses
            another speed, or does not send the required frames even on request.
        """
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            await WitMotionHandshake(port, emit, settings).ensure_streaming()
            await port.pump(emit, settings.lost_after_s)
