"""Sensor fusion: limb states from aligned orientations, with detection of sensor faults."""

from jointfit_daemon.fusion._limb_fuser import LimbFuser
from jointfit_daemon.fusion._optical_limb import OpticalLimb, OpticalReading
from jointfit_daemon.fusion._optical_origin import OpticalOrigin
from jointfit_daemon.fusion._segment_fuser import HEADING_SD
from jointfit_daemon.fusion._sensor_states import sensor_states
from jointfit_daemon.fusion.faults import SensorMonitor, SensorReport

__all__ = [
    "HEADING_SD",
    "LimbFuser",
    "OpticalLimb",
    "OpticalOrigin",
    "OpticalReading",
    "SensorMonitor",
    "SensorReport",
    "sensor_states",
]
