"""Virtual IMUs and a virtual motion-capture server that behave like real devices."""

from jointfit_simulators.devices._cameras import CameraFrames, Cameras
from jointfit_simulators.devices._clocks import NS, ClockFault, DeviceClock, Samples, Ticker
from jointfit_simulators.devices._natnet_options import NatNetServerOptions
from jointfit_simulators.devices._natnet_port import LOOPBACK
from jointfit_simulators.devices._natnet_server import NatNetServer
from jointfit_simulators.devices._natnet_stage import (
    Bodies,
    Markers,
    Pose,
    Stage,
    StagedBody,
    Stamps,
    Vector,
    model_definition,
)
from jointfit_simulators.devices._orientation_sensor import OrientationSensor
from jointfit_simulators.devices._sensor_faults import Mishaps
from jointfit_simulators.devices._xbus_device import XbusDevice, XbusDeviceOptions
from jointfit_simulators.devices._xcdi_device import XcdiDevice, XcdiDeviceOptions

__all__ = [
    "LOOPBACK",
    "NS",
    "Bodies",
    "CameraFrames",
    "Cameras",
    "ClockFault",
    "DeviceClock",
    "Markers",
    "Mishaps",
    "NatNetServer",
    "NatNetServerOptions",
    "OrientationSensor",
    "Pose",
    "Samples",
    "Stage",
    "StagedBody",
    "Stamps",
    "Ticker",
    "Vector",
    "XbusDevice",
    "XbusDeviceOptions",
    "XcdiDevice",
    "XcdiDeviceOptions",
    "model_definition",
]
