"""Reception of the frames of one device on a CAN bus, across all connection attempts."""

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
"""Longest wait for the first frame of a lost device, s. The wait doubles with every attempt. During
the wait the driver stays subscribed to the device's frames, so it receives the first frame at once.
After the first frame, the longest wait for a frame is `silence_s`."""
_RAW_FRAMES = 20
"""Number of frames of each attempt that are logged at debug level, as raw data of the device."""


class CanDeviceSettings(Protocol):
    """Keys that the ``[[imu]]`` table of a device on a CAN bus must have."""

    @property
    def id(self) -> str:
        """Name of the sensor."""

    @property
    def can(self) -> CanBusSettings:
        """Settings of the sensor's CAN bus."""

    @property
    def silence_s(self) -> float:
        """Time without a frame after which the device counts as lost, s."""


class CanReception:
    """Receives the frames of one device.

    Parameters
    ----------
    settings : CanDeviceSettings
        Table of the device in rig.toml.
    configured_by : str
        Description of how to change the device's identifiers and outputs, for error messages.
    """

    def __init__(self, settings: CanDeviceSettings, configured_by: str) -> None:
        self._settings = settings
        self._configured_by = configured_by
        self._worked = False
        self._first_s = settings.silence_s  # longest wait for the first frame, s

    async def run(
        self,
        emit: Emit,
        ids: Mapping[CanKey, str],
        needed: CanKey,
        resembles: Callable[[bytes], bool] = lambda _: False,
    ) -> None:
        """Until cancelled, emit the frames whose identifier is in `ids`; see `SharedBus.pump`.

        Parameters
        ----------
        emit : callable
            Function that receives chunks of packed frames.
        ids : mapping
            Identifiers of the device, each with the name of its quantity for error messages.
        needed : CanKey
            Identifier of the frames with measurements; one of `ids`.
        resembles : callable
            Function that returns whether the data of a frame resemble the data of `needed` frames.
            The result is used for a hint in the error message.
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
