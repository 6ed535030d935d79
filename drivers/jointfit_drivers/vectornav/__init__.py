"""Driver for VectorNav IMUs with binary outputs on a serial port or USB."""

from jointfit_drivers.vectornav._decoder import VectorNavDecoder
from jointfit_drivers.vectornav._driver import VectorNavImu
from jointfit_drivers.vectornav._settings import VectorNavSettings

__all__ = ["VectorNavDecoder", "VectorNavImu", "VectorNavSettings"]
