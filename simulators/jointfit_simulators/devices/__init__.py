"""Virtual IMUs and virtual motion-capture servers that behave like real devices."""

from jointfit_simulators.devices._bno085_device import Bno085Device, Bno085DeviceOptions
from jointfit_simulators.devices._cameras import CameraFrames, Cameras
from jointfit_simulators.devices._clocks import (
    ClockFault,
    PlannedSamples,
    SampleTiming,
    SimulatedClock,
)
from jointfit_simulators.devices._lpms_can_device import LpmsCanDevice, LpmsCanDeviceOptions
from jointfit_simulators.devices._lpms_device import LpmsDevice, LpmsDeviceOptions
from jointfit_simulators.devices._lsl_server import LslServer, LslServerOptions
from jointfit_simulators.devices._mip_device import MipDevice, MipDeviceOptions
from jointfit_simulators.devices._natnet_frames import (
    Bodies,
    FrameStamps,
    Markers,
    NatNetFrameBuilder,
    Pose,
    RigidBodyAsset,
    Vector,
    model_definition,
)
from jointfit_simulators.devices._natnet_options import NatNetServerOptions
from jointfit_simulators.devices._natnet_port import LOOPBACK, Address, NatNetPort
from jointfit_simulators.devices._natnet_server import NatNetServer
from jointfit_simulators.devices._orientation_sensor import OrientationSensor
from jointfit_simulators.devices._qtm_server import QtmServer, QtmServerOptions
from jointfit_simulators.devices._sensor_errors import SensorErrors, VectorErrors
from jointfit_simulators.devices._sensor_faults import SensorFaults
from jointfit_simulators.devices._table_device import (
    CanTablePort,
    SerialTablePort,
    TableDevice,
    TableDeviceOptions,
)
from jointfit_simulators.devices._tcp_port import TcpClient, TcpPort, TextServer
from jointfit_simulators.devices._vectornav_device import VectorNavDevice, VectorNavDeviceOptions
from jointfit_simulators.devices._vicon_server import ViconServer, ViconServerOptions
from jointfit_simulators.devices._vrpn_options import VrpnServerOptions
from jointfit_simulators.devices._vrpn_server import VrpnServer
from jointfit_simulators.devices._witmotion_device import (
    WITH_QUATERNION,
    WitMotionDevice,
    WitMotionDeviceOptions,
)
from jointfit_simulators.devices._xbus_device import XbusDevice, XbusDeviceOptions
from jointfit_simulators.devices._xcdi_device import XcdiDevice, XcdiDeviceOptions
from jointfit_simulators.devices._ximu3_device import XImu3Device, XImu3DeviceOptions

__all__ = [
    "LOOPBACK",
    "WITH_QUATERNION",
    "Address",
    "Bno085Device",
    "Bno085DeviceOptions",
    "Bodies",
    "CameraFrames",
    "Cameras",
    "CanTablePort",
    "ClockFault",
    "FrameStamps",
    "LpmsCanDevice",
    "LpmsCanDeviceOptions",
    "LpmsDevice",
    "LpmsDeviceOptions",
    "LslServer",
    "LslServerOptions",
    "Markers",
    "MipDevice",
    "MipDeviceOptions",
    "NatNetFrameBuilder",
    "NatNetPort",
    "NatNetServer",
    "NatNetServerOptions",
    "OrientationSensor",
    "PlannedSamples",
    "Pose",
    "QtmServer",
    "QtmServerOptions",
    "RigidBodyAsset",
    "SampleTiming",
    "SensorErrors",
    "SensorFaults",
    "SerialTablePort",
    "SimulatedClock",
    "TableDevice",
    "TableDeviceOptions",
    "TcpClient",
    "TcpPort",
    "TextServer",
    "Vector",
    "VectorErrors",
    "VectorNavDevice",
    "VectorNavDeviceOptions",
    "ViconServer",
    "ViconServerOptions",
    "VrpnServer",
    "VrpnServerOptions",
    "WitMotionDevice",
    "WitMotionDeviceOptions",
    "XImu3Device",
    "XImu3DeviceOptions",
    "XbusDevice",
    "XbusDeviceOptions",
    "XcdiDevice",
    "XcdiDeviceOptions",
    "model_definition",
]
