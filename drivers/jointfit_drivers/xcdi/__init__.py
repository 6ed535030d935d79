"""Driver for Xsens XCDI IMUs on a CAN bus."""

from jointfit_drivers.xcdi._decoder import XcdiDecoder
from jointfit_drivers.xcdi._driver import XcdiIdSettings, XcdiImu, XcdiSettings

__all__ = ["XcdiDecoder", "XcdiIdSettings", "XcdiImu", "XcdiSettings"]
