"""The ``[[imu]]`` table of an LPMS sensor on a CAN bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field
from typing_extensions import override

from jointfit_daemon.driver import Settings
from jointfit_drivers.can_imu import CanImuSettings
from jointfit_drivers.lpms._convention_settings import LpmsConventionSettings
from jointfit_protocols.can import STANDARD_MAX
from jointfit_protocols.lpms.channels import (
    FRAME_BYTES,
    FRAMES,
    HEARTBEAT,
    PER_FRAME,
    TPDO,
    ChannelIds,
    tpdo_ids,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

_MOST_NODES = 127


class LpmsCanIdSettings(Settings):
    """CAN identifiers of the four channel frames, as LpmsControl displays them."""

    frame1: int = Field(ge=0, le=STANDARD_MAX, description="identifier of the first frame")
    frame2: int = Field(ge=0, le=STANDARD_MAX, description="identifier of the second frame")
    frame3: int = Field(ge=0, le=STANDARD_MAX, description="identifier of the third frame")
    frame4: int = Field(ge=0, le=STANDARD_MAX, description="identifier of the fourth frame")

    @property
    def frames(self) -> tuple[int, int, int, int]:
        """Identifiers in the order of the channels."""
        return self.frame1, self.frame2, self.frame3, self.frame4


class LpmsCanSettings(CanImuSettings, LpmsConventionSettings):
    """One LP-Research LPMS sensor on a CAN bus."""

    mode: Literal["canopen", "sequential"] = Field(
        description="`canopen`: 0x180, 0x280, 0x380 and 0x480 plus the node number, with a "
        "heartbeat; `sequential`: four consecutive identifiers",
    )
    ids: LpmsCanIdSettings = Field(
        description="identifiers of the four frames; all four are needed, because the vendor's "
        "sources compute sequential identifiers by two different rules",
    )
    precision: Literal["int16", "float32"] = Field(
        description="format of the channels, as set with LpmsControl"
    )
    mapping: tuple[int, int, int, int] = Field(
        (1, 2, 3, 4), description="channels that carry w, x, y and z, counted from 1"
    )

    @property
    def channel_ids(self) -> ChannelIds:
        """Identifiers of the sensor's channel frames and heartbeat."""
        frames = self.ids.frames
        beat = HEARTBEAT + frames[0] - TPDO[0] if self.mode == "canopen" else None
        return ChannelIds(frames, beat)

    @property
    @override
    def can_frames(self) -> tuple[tuple[int, bool], ...]:
        return ((FRAME_BYTES, False),) * FRAMES

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield identifiers that the mode does not permit, and channels that do not exist."""
        known: Any = (self.mode, self.ids, self.precision, self.mapping)  # None: key cannot be read
        if None in known:
            return
        frames = self.ids.frames
        found = ", ".join(f"0x{number:03X}" for number in frames)
        node = frames[0] - TPDO[0]
        if self.mode == "canopen" and (frames != tpdo_ids(node) or not 0 < node <= _MOST_NODES):
            yield (
                "ids",
                "CANopen style is 0x180, 0x280, 0x380 and 0x480 plus the node number (1 to 127), "
                f'found {found}: correct them, or set mode = "sequential"',
            )
        if self.mode == "sequential" and frames != tuple(range(frames[0], frames[0] + FRAMES)):
            yield (
                "ids",
                f"sequential identifiers follow each other, found {found}: correct them, or set "
                'mode = "canopen"',
            )

        channels = FRAMES * PER_FRAME[self.precision]
        if len(set(self.mapping)) < len(self.mapping) or not all(
            1 <= channel <= channels for channel in self.mapping
        ):
            yield (
                "mapping",
                f"four different channels from 1 to {channels} ({self.precision}), found "
                f"{list(self.mapping)}: set the channels of w, x, y and z",
            )
