"""Devices of this host: serial ports, CAN interfaces and servers of motion capture.

Functions named ``find_…`` read files of the kernel, and open no device. The other functions open
the named device only, and write nothing to it.
"""

from jointfit_daemon.tools.discovery._can_interfaces import (
    CanInterface,
    configured_can_channels,
    find_can_interfaces,
)
from jointfit_daemon.tools.discovery._mocap_servers import FoundServer, find_mocap_servers
from jointfit_daemon.tools.discovery._serial_ports import SerialPortInfo, find_serial_ports

__all__ = [
    "CanInterface",
    "FoundServer",
    "SerialPortInfo",
    "configured_can_channels",
    "find_can_interfaces",
    "find_mocap_servers",
    "find_serial_ports",
]
