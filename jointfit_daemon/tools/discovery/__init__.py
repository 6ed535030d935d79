"""Devices of this host: serial ports, CAN interfaces and motion-capture servers.

No function writes to a serial port or CAN interface, or changes its settings permanently.
`find_serial_ports` and `find_can_interfaces` open no device. `listen_serial` and `listen_can` open
the named device. `find_mocap_servers` sends requests to servers in the network.
"""

from jointfit_daemon.tools.discovery._can_interfaces import (
    CanChannel,
    CanInterface,
    RunCommand,
    configured_can_channels,
    find_can_interfaces,
    run_command,
)
from jointfit_daemon.tools.discovery._can_listening import CanIdentifier, CanTraffic, listen_can
from jointfit_daemon.tools.discovery._mocap_servers import (
    FoundServer,
    find_mocap_servers,
    installed_drivers,
)
from jointfit_daemon.tools.discovery._serial_listening import (
    SerialTraffic,
    listen_serial,
    usual_bauds,
)
from jointfit_daemon.tools.discovery._serial_ports import SerialPortInfo, find_serial_ports
from jointfit_daemon.tools.discovery._sysfs import read_attribute
from jointfit_daemon.tools.discovery._traffic import (
    LEAST_SAMPLES,
    DecodedDevice,
    Layouts,
    decode_frames,
    decode_stream,
    decode_traffic,
)

__all__ = [
    "LEAST_SAMPLES",
    "CanChannel",
    "CanIdentifier",
    "CanInterface",
    "CanTraffic",
    "DecodedDevice",
    "FoundServer",
    "Layouts",
    "RunCommand",
    "SerialPortInfo",
    "SerialTraffic",
    "configured_can_channels",
    "decode_frames",
    "decode_stream",
    "decode_traffic",
    "find_can_interfaces",
    "find_mocap_servers",
    "find_serial_ports",
    "installed_drivers",
    "listen_can",
    "listen_serial",
    "read_attribute",
    "run_command",
    "usual_bauds",
]
