"""Keys of all LPMS sensors: the convention of their quaternions."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from jointfit_daemon.driver import Settings


class LpmsConventionSettings(Settings):
    """Meaning of the quaternions of an LPMS sensor; the defaults were never tested on hardware."""

    direction: Literal["world_to_sensor", "sensor_to_world"] = Field(
        "world_to_sensor",
        description="whether the sensor's quaternions map world to sensor coordinates, or the "
        "reverse; both ROS drivers of the vendor invert them, and [a turn by "
        "hand](devices/lpms.md#convention) shows which applies",
    )
    world: Literal["NWU", "ENU", "NED"] = Field(
        "NWU",
        description="axes of the sensor's world; the vendor's manual states x to magnetic north, "
        "y west, z up",
    )
    scale: Literal["auto", 10_000, 1_000, 32_767] = Field(
        "auto",
        description="number of counts for 1.0 in 16-bit data; auto: determined from the norm of "
        "the quaternions",
    )
