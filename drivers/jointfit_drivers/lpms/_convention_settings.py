"""Keys of all LPMS sensors: the convention of their quaternions."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_daemon.driver import Settings


class LpmsConventionSettings(Settings):
    """Meaning of the quaternions of an LPMS sensor; the defaults were never tested on hardware."""

    direction: Literal["world_to_sensor", "sensor_to_world"] = Field(
        "world_to_sensor",
        description="whether its quaternions map world to sensor coordinates, or the reverse; both "
        "ROS drivers of the vendor invert them, and [a turn by "
        "hand](devices/lpms.md#convention) shows which applies",
    )
    world: Literal["NWU", "ENU", "NED"] = Field(
        "NWU",
        description="axes of its world: x to magnetic north, y west, z up by the vendor's manual",
    )
    scale: Literal["auto", 10_000, 1_000, 32_767] = Field(
        "auto", description="counts of 1.0 in 16-bit data; auto: from the norm of the quaternions"
    )
