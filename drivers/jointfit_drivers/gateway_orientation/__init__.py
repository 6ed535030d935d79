"""Orientation on the gateway, from the raw measurements of one IMU."""

from jointfit_drivers.gateway_orientation._filter import (
    LONGEST_SETTLE_S,
    PACKAGE_MISSING,
    SETTLE_S,
    FilterOutput,
    FilterState,
    FilterStep,
    GatewayOrientation,
    RawReading,
    is_installed,
    is_plausible,
)

__all__ = [
    "LONGEST_SETTLE_S",
    "PACKAGE_MISSING",
    "SETTLE_S",
    "FilterOutput",
    "FilterState",
    "FilterStep",
    "GatewayOrientation",
    "RawReading",
    "is_installed",
    "is_plausible",
]
