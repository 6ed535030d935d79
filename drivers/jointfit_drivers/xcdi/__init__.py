"""Driver for Xsens IMUs that use the protocol XCDI on a CAN bus."""

from jointfit_drivers.xcdi._decoder import XcdiDecoder
from jointfit_drivers.xcdi._driver import XcdiIdSettings, XcdiImu, XcdiSettings

__all__ = ["XcdiDecoder", "XcdiIdSettings", "XcdiImu", "XcdiSettings"]
