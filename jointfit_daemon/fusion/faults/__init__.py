"""Detection of stuck sensors, sensor slip, heading drift and magnetic disturbance."""

from jointfit_daemon.fusion.faults._consistency_monitor import ConsistencyMonitor
from jointfit_daemon.fusion.faults._sensor_monitor import (
    SensorMonitor,
    SensorReport,
    SensorState,
)

__all__ = ["ConsistencyMonitor", "SensorMonitor", "SensorReport", "SensorState"]
