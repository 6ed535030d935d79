"""Driver of IMUs on a CAN bus whose frames rig.toml or a DBC file describes.

The driver sends nothing, because a table does not describe how a device is configured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.can_reception import CanReception
from jointfit_drivers.can_table._decoder import CanTableDecoder
from jointfit_drivers.can_table._settings import CanTableSettings

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire


class CanTableImu:
    """One device that sends frames as its ``[[imu]]`` table describes."""

    Settings: ClassVar[type[CanTableSettings]] = CanTableSettings
    wire: ClassVar[Wire] = "can"

    def __init__(self, settings: CanTableSettings) -> None:
        self._settings = settings
        self._reception = CanReception(settings, "with the configuration program of the device")

    def decoder(self) -> CanTableDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        return CanTableDecoder(settings.can_table(), settings.sample_form())

    async def run(self, emit: Emit) -> None:
        """Emit the frames of the device until cancelled.

        Raises
        ------
        DeviceLostError
            The bus is absent or down, the adapter is unplugged, or the device is silent for
            `silence_s`.
        DeviceMisconfiguredError
            This type of bus is not available, or another sensor of the rig uses the same
            identifiers.
        """
        keys, names = self._settings.keys(), self._settings.order()
        await self._reception.run(emit, dict(zip(keys, names, strict=True)), needed=keys[-1])
