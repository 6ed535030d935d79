"""One aligned frame in, one LimbState out, whatever sensors are alive."""

from jointfit_daemon.fusion.limb import LimbFuser
from jointfit_daemon.fusion.origin import OpticalOrigin

__all__ = ["LimbFuser", "OpticalOrigin"]
