"""Driver of IMUs on a CAN bus that rig.toml or a DBC file describes.

The driver only receives: a table does not describe how a device is configured.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, ClassVar

from jointfit_drivers.can_table._decoder import CanTableDecoder
from jointfit_drivers.can_table._settings import CanTableSettings
from jointfit_drivers.ports.can_bus import shared_bus
from jointfit_protocols.can import unpack_frames

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire
    from jointfit_daemon.model import Chunk

log = logging.getLogger(__name__)

_LONGEST_SILENCE_S = 30.0
"""Longest wait, s, for the first frame of a device that is lost; the wait doubles with every
attempt. The device stays subscribed meanwhile, so its first frame is received at once. From then
on `silence_s` applies."""
_RAW_FRAMES = 20
"""Frames logged at debug level, so that the log contains raw data of a device."""


class CanTableImu:
    """One device that sends frames as its table describes."""

    Settings: ClassVar[type[CanTableSettings]] = CanTableSettings
    wire: ClassVar[Wire] = "can"

    def __init__(self, settings: CanTableSettings) -> None:
        self._settings = settings
        self._worked = False
        self._first_s = settings.silence_s  # waiting is cheap; opening the bus again is not

    def decoder(self) -> CanTableDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        settings = self._settings
        return CanTableDecoder(settings.can_table(), settings.sample_form())

    async def run(self, emit: Emit) -> None:
        """Read the bus until cancelled.

        Raises
        ------
        DeviceLostError
            The bus is absent or down, the adapter unplugged, or this device silent for `silence_s`.
        DeviceMisconfiguredError
            This kind of bus is not available, or another sensor of the rig uses the same
            identifiers.
        """
        settings = self._settings
        keys, names = settings.keys(), settings.order()
        left = _RAW_FRAMES if log.isEnabledFor(logging.DEBUG) else 0

        def emit_sample(chunk: Chunk) -> None:
            nonlocal left
            if left:
                for frame in unpack_frames(chunk.data)[:left]:
                    left -= 1
                    log.debug("%s: %s", settings.id, frame)
            self._first_s = settings.silence_s
            self._worked = True
            emit(chunk)

        first_s = self._first_s
        self._first_s = min(2 * first_s, max(settings.silence_s, _LONGEST_SILENCE_S))
        async with shared_bus(settings.can) as bus:
            await bus.pump(
                settings.id,
                dict(zip(keys, names, strict=True)),
                emit_sample,
                settings.silence_s,
                needed=keys[-1],
                first_s=first_s,
                worked=self._worked,
                configured_by="with the configuration program of the device",
            )
