"""Driver for the Vicon programs Nexus, Tracker, Shogun and Evoke, by their protocol DataStream."""

from jointfit_drivers.vicon._decoder import ViconDecoder
from jointfit_drivers.vicon._driver import ViconMocap
from jointfit_drivers.vicon._settings import ViconSettings

__all__ = ["ViconDecoder", "ViconMocap", "ViconSettings"]
