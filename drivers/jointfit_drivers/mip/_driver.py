"""Driver of MicroStrain IMUs that use MIP on a serial port or USB.

`MipDecoder` is the pure part. `MipImu.run` opens the port, makes the device stream and reads until
cancelled. The two share only chunks.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.mip._decoder import MipDecoder
from jointfit_drivers.mip._handshake import LINE_SPEEDS, MipHandshake
from jointfit_drivers.mip._settings import MipSettings
from jointfit_drivers.ports.serial_port import SerialPort

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire

_PERIODS_OF_SILENCE = 3
"""Smallest number of sample periods without data after which a device counts as silent."""
_HUNT_EVERY = 10
"""Number of attempts to connect per search at other speeds, which takes longer than an attempt."""


class MipImu:
    """One MIP device: orientation and device time, ns."""

    Settings: ClassVar[type[MipSettings]] = MipSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: MipSettings) -> None:
        self._settings = settings
        self._attempts = 0

    def decoder(self) -> MipDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        make_raw = None
        if settings.orientation == "gateway":
            make_raw = partial(RawSamples.of, settings)
        return MipDecoder(settings.line_baud, settings.required, make_raw)

    async def run(self, emit: Emit) -> None:
        """Open the port, make the device stream, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``silence_s``. A retry may succeed.
        DeviceMisconfiguredError
            The file is no serial port, the speed is another, no MIP device answers, or it cannot
            send the orientation at this rate.
        """
        settings = self._settings

        with SerialPort(settings.port, settings.baud) as port:
            hunt = self._attempts % _HUNT_EVERY == 0
            self._attempts += 1
            await MipHandshake(port, emit, settings, hunt=hunt).ensure_streaming()
            self._attempts = 0

            silence_s = max(settings.silence_s, _PERIODS_OF_SILENCE / settings.rate_hz)
            await port.pump(emit, silence_s)
