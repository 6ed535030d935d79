"""Reception of the frames of one device on a CAN bus, over all attempts of its driver."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Protocol

from jointfit_drivers.ports.can_bus import shared_bus
from jointfit_protocols.can import unpack_frames

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.driver import CanBusSettings, Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.ports.can_bus import CanKey

log = logging.getLogger(__name__)

_LONGEST_SILENCE_S = 30.0
"""Longest wait, s, for the first frame of a device that is lost; the wait doubles with every
attempt. The device stays subscribed meanwhile, so its first frame is received at once. From then
on `silence_s` applies."""
_RAW_FRAMES = 20
"""Frames logged at debug level, so that the log contains raw data of a device."""


class CanDeviceSettings(Protocol):
    """Keys of an ``[[imu]]`` table on a CAN bus."""

    @property
    def id(self) -> str:
        """Name of the sensor."""

    @property
    def can(self) -> CanBusSettings:
        """Settings of the CAN bus of the sensor."""

    @property
    def silence_s(self) -> float:
        """Time without a frame after which it counts as lost, s."""


class CanReception:
    """Receives the frames of one device.

    Parameters
    ----------
    settings : CanDeviceSettings
        Table of the device in rig.toml.
    configured_by : str
        How its identifiers and outputs are changed, for error messages.
    """

    def __init__(self, settings: CanDeviceSettings, configured_by: str) -> None:
        self._settings = settings
        self._configured_by = configured_by
        self._worked = False
        self._first_s = settings.silence_s  # waiting is cheap; opening the bus again is not

    async def run(
        self,
        emit: Emit,
        ids: Mapping[CanKey, str],
        needed: CanKey,
        resembles: Callable[[bytes], bool] = lambda _: False,
    ) -> None:
        """Emit the frames with one of `ids` until cancelled; see `SharedBus.pump`.

        Parameters
        ----------
        emit : callable
            Receives chunks of packed frames.
        ids : mapping
            Name of the quantity that each identifier carries, for error messages.
        needed : CanKey
            Identifier in `ids` of the frames with measurements.
        resembles : callable
            Whether the data of a frame resemble the data of `needed`, for a hint in the error
            message.
        """
        settings = self._settings
        left = _RAW_FRAMES if log.isEnabledFor(logging.DEBUG) else 0

        def emit_frames(chunk: Chunk) -> None:
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
                ids,
                emit_frames,
                settings.silence_s,
                needed=needed,
                first_s=first_s,
                resembles=resembles,
                worked=self._worked,
                configured_by=self._configured_by,
            )
