"""The ``[mocap]`` table of a Vicon DataStream server."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_drivers.motion_capture import ServerSettings

PORT = 801
"""Default port of the DataStream."""


class ViconSettings(ServerSettings):
    """The ``[mocap]`` table for Vicon Nexus, Tracker, Shogun, Evoke and Blade."""

    server: str = Field(description="address or name of the PC that runs the Vicon software")
    command_port: int = Field(PORT, ge=1, le=65535, description="port of the DataStream")
    up_axis: Literal["auto", "x", "y", "z"] = Field(  # type: ignore[assignment]  # it is announced
        "auto", description="vertical axis of the stream; `auto`: as the server announces it"
    )
    least_quality: float = Field(
        0.2, ge=0, le=1, description="quality of a subject below which the driver warns"
    )
    latency_ms: float = Field(
        2.0,
        ge=0,
        le=1000,
        description="the part of the delay from exposure to arrival that the server does not "
        "announce, ms",
    )

    @property
    def usual_delay_ms(self) -> tuple[float, float]:
        """Mean and standard deviation of the delay that the server does not announce, ms."""
        return self.latency_ms, max(self.latency_ms / 2, 1.0)
