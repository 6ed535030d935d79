"""Detection of stuck sensors, sensor slip, heading drift and magnetic disturbance."""

from jointfit_daemon.fusion.faults._consistency_monitor import LinkWatch
from jointfit_daemon.fusion.faults._sensor_monitor import SensorNews, SensorWatch

__all__ = ["LinkWatch", "SensorNews", "SensorWatch"]
