"""The ``[mocap]`` table of a QTM server."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_drivers.motion_capture import ServerSettings

PORT = 22223
"""Default port of the little-endian protocol, which is the base port of QTM (22222) plus 1."""


class QtmSettings(ServerSettings):
    """The ``[mocap]`` table for Qualisys Track Manager."""

    server: str = Field(description="address or name of the PC that runs QTM")
    command_port: int = Field(
        PORT, ge=1, le=65535, description="little-endian port of QTM: its base port plus 1"
    )
    transport: Literal["udp", "tcp"] = Field(
        "udp",
        description="transport of the frames; commands use TCP. With `tcp` a lost packet delays "
        "the frames after it",
    )
    data_port: int | None = Field(
        None, ge=1, le=65535, description="UDP port of this host for frames; default: a free port"
    )
    up_axis: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = Field(  # type: ignore[assignment]  # QTM announces its axis
        "auto", description="vertical axis of the stream; `auto`: as QTM announces it"
    )
    skeleton: bool = Field(
        False, description="whether segments of skeletons are bodies, too, named `Skeleton/Segment`"
    )
    latency_ms: float = Field(
        10.0, ge=0, le=1000, description="usual delay from exposure to arrival, ms"
    )

    @property
    def usual_delay_ms(self) -> tuple[float, float]:
        """Mean and standard deviation of the delay from exposure to arrival, ms."""
        return self.latency_ms, self.latency_ms / 2
