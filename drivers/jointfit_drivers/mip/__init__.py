"""Driver for MicroStrain IMUs that use MIP on a serial port or USB."""

from jointfit_drivers.mip._decoder import MipDecoder
from jointfit_drivers.mip._driver import MipImu
from jointfit_drivers.mip._settings import MipSettings

__all__ = ["MipDecoder", "MipImu", "MipSettings"]
