"""The ``[mocap]`` table of a VRPN server."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_drivers.motion_capture import ServerSettings
from jointfit_protocols.vrpn import DEFAULT_PORT


class VrpnSettings(ServerSettings):
    """The ``[mocap]`` table for every system with a VRPN server.

    The body of a tracker with one sensor has the name of the tracker. The body of sensor 3 of the
    tracker ``Leg`` has the name ``Leg#3``.
    """

    port: int = Field(DEFAULT_PORT, ge=1, le=65535, description="port of the server")
    connection: Literal["tcp", "classic"] = Field(
        "tcp",
        description="`tcp`: connect to the server; `classic`: announce by UDP, and the server"
        " connects back, which most firewalls block",
    )
    transport: Literal["tcp", "udp"] = Field(
        "tcp", description="transport of the poses; over `udp` a lost pose is not sent again"
    )
    unit: Literal["m", "mm"] = Field("m", description="unit of the positions in the stream")
    time: Literal["server", "utc"] = Field(
        "server",
        description="`server`: wall clock of the server, which may drift and step; `utc`: PTP or"
        " NTP synchronizes it with this host's clock",
    )
