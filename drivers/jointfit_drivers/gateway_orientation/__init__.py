"""Computation of the orientation on the gateway, from the raw measurements of one IMU."""

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
    turned_field,
)
from jointfit_drivers.gateway_orientation._raw_samples import RawSamples, RawStamp
from jointfit_drivers.gateway_orientation._sensor_correction import SensorCorrection
from jointfit_drivers.gateway_orientation._settings import GatewaySettings

__all__ = [
    "LONGEST_SETTLE_S",
    "PACKAGE_MISSING",
    "SETTLE_S",
    "FilterOutput",
    "FilterState",
    "FilterStep",
    "GatewayOrientation",
    "GatewaySettings",
    "RawReading",
    "RawSamples",
    "RawStamp",
    "SensorCorrection",
    "is_installed",
    "is_plausible",
    "turned_field",
]
