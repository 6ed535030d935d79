"""One aligned frame in, one LimbState out, whatever sensors are alive."""

from jointfit_daemon.fusion.limb import LimbFuser
from jointfit_daemon.fusion.origin import OpticalOrigin
from jointfit_daemon.fusion.sensor_watch import SensorWatch

__all__ = ["LimbFuser", "OpticalOrigin", "SensorWatch"]
