"""Driver of VectorNav IMUs on a serial port or USB.

`VectorNavDecoder` is the pure part. `VectorNavImu.run` opens the port, makes the device stream and
reads until cancelled. The two share only chunks.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.vectornav._decoder import VectorNavDecoder
from jointfit_drivers.vectornav._handshake import LINE_SPEEDS, VectorNavHandshake
from jointfit_drivers.vectornav._settings import VectorNavSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire

_PERIODS_OF_SILENCE = 3
"""Smallest number of sample periods without data after which a device counts as silent."""
_HUNT_EVERY = 10
"""Number of attempts to connect per search at other speeds, which takes longer than an attempt."""


class VectorNavImu:
    """One VectorNav device: orientation and device time, ns."""

    Settings: ClassVar[type[VectorNavSettings]] = VectorNavSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = LINE_SPEEDS

    def __init__(self, settings: VectorNavSettings) -> None:
        self._settings = settings
        self._attempts = 0

    def decoder(self) -> VectorNavDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        make_raw = None
        if settings.orientation == "gateway":
            make_raw = partial(RawSamples.of, settings)
        inverse = settings.direction == "world_to_sensor"
        return VectorNavDecoder(
            settings.line_baud,
            world_to_sensor=inverse,
            make_raw=make_raw,
            rate_hz=settings.rate_hz,
            output=settings.output,
        )

    async def run(self, emit: Emit) -> None:
        """Open the port, make the device stream, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``silence_s``. A retry may succeed.
        DeviceMisconfiguredError
            The file is no serial port, the speed is another, no VectorNav device answers, or it
            cannot send the orientation at this rate.
        """
        settings = self._settings

        with SerialPort(settings.port, settings.baud) as port:
            hunt = self._attempts % _HUNT_EVERY == 0
            self._attempts += 1
            await VectorNavHandshake(port, emit, settings, hunt=hunt).ensure_streaming()
            self._attempts = 0

            silence_s = max(settings.silence_s, _PERIODS_OF_SILENCE / settings.rate_hz)
            await port.pump(emit, silence_s)
