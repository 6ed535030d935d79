"""Driver for the Vicon programs Nexus, Tracker, Shogun, Evoke and Blade, by the DataStream."""

from jointfit_drivers.vicon._decoder import ViconDecoder
from jointfit_drivers.vicon._driver import ViconMocap
from jointfit_drivers.vicon._settings import ViconSettings

__all__ = ["ViconDecoder", "ViconMocap", "ViconSettings"]
