"""Driver for Xsens IMUs that use the protocol Xbus on a serial port or USB."""

from jointfit_drivers.xbus._decoder import XbusDecoder
from jointfit_drivers.xbus._driver import XbusImu
from jointfit_drivers.xbus._settings import XbusSettings

__all__ = ["XbusDecoder", "XbusImu", "XbusSettings"]
