"""The core of the daemon: it converts input events to limb states, notices and calibration jobs."""

from jointfit_daemon.pipeline._core import Core
from jointfit_daemon.pipeline._moving_centers import MovingCenters
from jointfit_daemon.pipeline.sources import StampedMeasurement

__all__ = ["Core", "MovingCenters", "StampedMeasurement"]
