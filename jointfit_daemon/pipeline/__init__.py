"""The core of the daemon: it converts input events to limb states, notices and calibration jobs.

A notice is a message about a change, for example that a sensor is lost.
"""

from jointfit_daemon.pipeline._core import Core
from jointfit_daemon.pipeline._moving_centers import MovingCenters
from jointfit_daemon.pipeline.sources import StampedMeasurement

__all__ = ["Core", "MovingCenters", "StampedMeasurement"]
