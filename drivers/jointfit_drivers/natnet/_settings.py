"""The ``[mocap]`` table of a NatNet server."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_drivers.motion_capture import ServerSettings


class NatNetSettings(ServerSettings):
    """The ``[mocap]`` table for OptiTrack Motive and other servers of NatNet 2.5 to 4.x."""

    server: str = Field(description="address or name of the PC that runs Motive")
    transport: Literal["auto", "unicast", "multicast"] = Field(
        "auto", description="transport of the frames; `auto` follows the announcement of the server"
    )
    command_port: int = Field(1510, ge=1, le=65535, description="command port of the server")
    data_port: int | None = Field(
        None, ge=1, le=65535, description="port of multicast frames; default: as announced"
    )
    bitstream: Literal["3.0", "3.1", "4.0", "4.1", "4.2"] | None = Field(
        None, description="bitstream requested from a unicast 4.x server; default: the server's own"
    )
    latency_ms: float = Field(
        10.0,
        ge=0,
        le=1000,
        description="delay from exposure to transmission, for cameras without exposure stamps "
        "(USB) or with PTP, ms",
    )
    time: Literal["server", "ptp", "utc"] = Field(
        "server",
        description="clock of the frames: the `server`'s own counter, measured by echoes; or the "
        "precision timestamp of cameras on PTP (bitstream 4.1), if PTP also sets this host's "
        "clock: `ptp` for timestamps in TAI, `utc` for timestamps in UNIX time",
    )
    tai_minus_utc_s: int = Field(
        37, ge=0, le=100, description="leap seconds by which PTP time is ahead of UTC"
    )

    @property
    def wanted_version(self) -> tuple[int, int] | None:
        """The key `bitstream` as two numbers; None if the key is not set."""
        if self.bitstream is None:
            return None
        major, minor = self.bitstream.split(".")
        return int(major), int(minor)

    @property
    def usual_delay_ms(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the delay from exposure to arrival, ms.

        The value applies to frames that PTP-synchronized cameras stamp. For frames that the server
        stamps, the value is None, because echoes measure the server's clock.
        """
        return None if self.time == "server" else (self.latency_ms, self.latency_ms / 2)
