"""Driver of Xsens / Movella IMUs that use Xbus on a serial port or USB.

`XbusDecoder` is pure: it uses no clock and no I/O. `XbusImu.run` opens the port, brings the device
into measurement mode and reads until cancelled. The decoder receives only the chunks that `run`
emits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.serial_reception import SerialReception
from jointfit_drivers.xbus._decoder import XbusDecoder
from jointfit_drivers.xbus._handshake import LINE_SPEEDS, XbusHandshake
from jointfit_drivers.xbus._legacy_measurements import LegacyMeasurements
from jointfit_drivers.xbus._raw_orientation import RawOrientation
from jointfit_drivers.xbus._settings import XbusSettings
from jointfit_drivers.xbus._sync_lines import trigger_wires

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class XbusImu:
    """One Xbus device: orientation, device time in units of 100 us, and message counter."""

    Settings: ClassVar[type[XbusSettings]] = XbusSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = tuple(dict.fromkeys((115_200, *LINE_SPEEDS)))

    def __init__(self, settings: XbusSettings) -> None:
        self._settings = settings
        self._reception = SerialReception(settings)

    def decoder(self) -> XbusDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        baud = settings.baud if settings.transport == "uart" else None
        make_raw = RawSamples.maker(settings)
        raw = None if make_raw is None else RawOrientation(make_raw)

        legacy = None
        if settings.format == "mtdata":
            legacy = LegacyMeasurements(
                settings.output_mode, settings.output_settings, settings.legacy_world
            )
        wires = trigger_wires(settings.sync or ())
        return XbusDecoder(baud, settings.rate_hz, wires, raw, legacy, bus_id=settings.bus_id)

    async def run(self, emit: Emit) -> None:
        """Open the port, bring the device into measurement mode, and read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged, or silent for ``lost_after_s``. A retry may
            succeed.
        DeviceMisconfiguredError
            The file is not a serial port, or no Xbus device answers. Or the device uses another
            speed, or its output configuration differs while ``persist`` is false.
        """
        settings = self._settings
        await self._reception.run(
            emit,
            lambda port, hunt: XbusHandshake(port, emit, settings, hunt=hunt).ensure_measuring(),
        )
