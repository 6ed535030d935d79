"""Driver for motion capture by the protocol NatNet of OptiTrack, over UDP."""

from jointfit_drivers.natnet._decoder import NatNetDecoder
from jointfit_drivers.natnet._driver import NatNetMocap
from jointfit_drivers.natnet._settings import NatNetSettings

__all__ = ["NatNetDecoder", "NatNetMocap", "NatNetSettings"]
