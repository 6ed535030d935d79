"""Xsens / Movella IMUs that speak Xbus on a serial port or USB.

Law: two halves. ``XbusDecoder`` is pure; ``run`` opens the port, brings the device to measure and
reads until cancelled. Between them nothing but chunks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.xbus._decoder import XbusDecoder
from jointfit_drivers.xbus._handshake import Handshake
from jointfit_drivers.xbus._raw_orientation import XbusRaw
from jointfit_drivers.xbus._settings import XbusSettings
from jointfit_drivers.xbus._sync_lines import wires

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire

_PERIODS_OF_SILENCE = 3  # a slow device may be silent for two periods and be well
_HUNT_EVERY = 10  # attempts: a device that is off need not be looked for at nine speeds each second


class XbusImu:
    """One Xbus device: orientation, its own 100 us clock, a counter over all it sends."""

    Settings: ClassVar[type[XbusSettings]] = XbusSettings
    wire: ClassVar[Wire] = "stream"

    def __init__(self, settings: XbusSettings) -> None:
        self._settings = settings
        self._attempts = 0

    def decoder(self) -> XbusDecoder:
        """Return the pure half: chunks in, samples in SI out. Live and replay use the same."""
        settings = self._settings
        baud = settings.baud if settings.transport == "uart" else None
        raw = None
        if settings.orientation == "gateway":
            raw = XbusRaw(
                settings.rate_hz,
                magnetometer=settings.magnetometer,
                settle_s=settings.settle_s,
            )
        return XbusDecoder(baud, settings.rate_hz, wires(settings.sync or ()), raw)

    async def run(self, emit: Emit) -> None:
        """Open the port, bring the device to measure, read until cancelled.

        Raises
        ------
        DeviceLostError
            Port absent, taken, unplugged or silent for ``silence_s``; worth another try.
        DeviceMisconfiguredError
            Not a serial port, another speed, no Xbus device, or an output configuration that
            differs while ``persist`` is false.
        """
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            hunt = self._attempts % _HUNT_EVERY == 0
            self._attempts += 1
            await Handshake(port, emit, settings, hunt=hunt).ensure_measuring()
            self._attempts = 0
            silence_s = max(settings.silence_s, _PERIODS_OF_SILENCE / settings.rate_hz)
            await port.pump(emit, silence_s)
