"""Driver of LP-Research LPMS sensors on CAN.

The driver only receives. The user configures the sensor once over its UART or USB with the vendor's
tool. The configuration consists of the identifiers, the precision, and the quantity of each
channel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from jointfit_drivers.can_reception import CanReception
from jointfit_drivers.lpms._can_decoder import LpmsCanDecoder
from jointfit_drivers.lpms._can_settings import LpmsCanSettings
from jointfit_protocols.lpms import UNITS, unit_of
from jointfit_protocols.lpms.channels import (
    FRAME_BYTES,
    FRAMES,
    TPDO,
    decode_frame,
    frames_of,
    tpdo_ids,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from jointfit_daemon.driver import Emit, Wire

_MOST = 1.01
"""Largest plausible component of a quaternion."""
_LEAST = 1e-12
"""Smallest plausible component other than 0. Smaller values are integers interpreted as floats."""


class LpmsCanImu:
    """LPMS sensor on a CAN bus. It sends each orientation in one or more frames, and no time."""

    Settings: ClassVar[type[LpmsCanSettings]] = LpmsCanSettings
    wire: ClassVar[Wire] = "can"

    @classmethod
    def candidate_tables(cls, seen: Mapping[tuple[int, bool], int]) -> Iterator[dict[str, Any]]:
        """Yield the settings of sensors that may have sent the received frames.

        The first frame of a candidate has 8 bytes. It belongs to a node in CANopen style, or is the
        first of four frames with consecutive identifiers. Each candidate is tried with 16-bit
        integers, and with floats if its second frame also has 8 bytes. See
        `jointfit_daemon.device_search`.
        """
        full = {number for (number, long), size in seen.items() if size == FRAME_BYTES and not long}
        for number in sorted(full):
            node = number - TPDO[0]
            tables: list[tuple[str, tuple[int, ...]]] = []
            if 0 < node < TPDO[1] - TPDO[0]:
                tables.append(("canopen", tpdo_ids(node)))
            consecutive = tuple(range(number, number + FRAMES))
            if full.issuperset(consecutive):
                tables.append(("sequential", consecutive))

            for mode, numbers in tables:
                ids = {f"frame{k}": each for k, each in enumerate(numbers, 1)}
                yield {"mode": mode, "ids": ids, "precision": "int16"}
                if numbers[1] in full:
                    yield {"mode": mode, "ids": ids, "precision": "float32"}

    def __init__(self, settings: LpmsCanSettings) -> None:
        self._settings = settings
        self._reception = CanReception(settings, "over UART or USB, with LpmsControl")

    def decoder(self) -> LpmsCanDecoder:
        """Return the decoder from chunks to samples, for live data and replay."""
        return LpmsCanDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Emit the frames of the sensor until cancelled.

        Raises
        ------
        DeviceLostError
            The bus is absent or down, the adapter is unplugged, or the sensor is silent for
            `silence_s`.
        DeviceMisconfiguredError
            This type of bus is not available, or another sensor of the rig uses the same
            identifiers.
        """
        settings, precision = self._settings, self._settings.precision
        numbers, heartbeat = settings.channel_ids
        ids = {(number, False): f"frame{k}" for k, number in enumerate(numbers, 1)}
        if heartbeat is not None:
            ids[heartbeat, False] = "heartbeat"
        last = frames_of(settings.mapping, precision)[-1]

        def resembles(data: bytes) -> bool:
            """Return whether `data` may contain a quaternion or half a quaternion."""
            values = decode_frame(data, precision)
            if values is None:
                return False
            if precision == "int16":
                return unit_of(values) in UNITS
            sizes = [abs(value) for value in values]
            return max(sizes) <= _MOST and any(size > _LEAST for size in sizes)

        await self._reception.run(emit, ids, (numbers[last], False), resembles)
