"""Drivers for LP-Research LPMS sensors, with LP-BUS on a serial port or USB, or on a CAN bus."""

from jointfit_drivers.lpms._can_decoder import LpmsCanDecoder
from jointfit_drivers.lpms._can_driver import LpmsCanImu
from jointfit_drivers.lpms._can_settings import LpmsCanIdSettings, LpmsCanSettings
from jointfit_drivers.lpms._decoder import LpmsDecoder
from jointfit_drivers.lpms._driver import LpmsImu
from jointfit_drivers.lpms._settings import LpmsSettings

__all__ = [
    "LpmsCanDecoder",
    "LpmsCanIdSettings",
    "LpmsCanImu",
    "LpmsCanSettings",
    "LpmsDecoder",
    "LpmsImu",
    "LpmsSettings",
]
