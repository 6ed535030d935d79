"""Driver for WitMotion IMUs on a serial port or USB bridge."""

from jointfit_drivers.witmotion._decoder import WitMotionDecoder
from jointfit_drivers.witmotion._driver import WitMotionImu
from jointfit_drivers.witmotion._settings import WitMotionSettings

__all__ = ["WitMotionDecoder", "WitMotionImu", "WitMotionSettings"]
