"""Driver for motion capture by the Virtual-Reality Peripheral Network (VRPN), over TCP and UDP."""

from jointfit_drivers.vrpn._decoder import VrpnDecoder
from jointfit_drivers.vrpn._driver import VrpnMocap
from jointfit_drivers.vrpn._settings import VrpnSettings

__all__ = ["VrpnDecoder", "VrpnMocap", "VrpnSettings"]
