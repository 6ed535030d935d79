"""Driver for motion capture with OptiTrack's protocol NatNet, over UDP."""

from jointfit_drivers.natnet._decoder import NatNetDecoder
from jointfit_drivers.natnet._driver import NatNetMocap
from jointfit_drivers.natnet._settings import NatNetSettings

__all__ = ["NatNetDecoder", "NatNetMocap", "NatNetSettings"]
