"""Virtual devices of a scene and their tables in rig.toml.

By default every other sensor uses a UART (Xbus, one pty each) and the others use CAN (XCDI, behind
one SLCAN adapter on a pty or on a python-can bus). The optical system is a NatNet server on
loopback.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from jointfit_protocols.xbus.configuration import SyncSetting
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_protocols.xbus.sync_lines import IN1, Polarity, SyncFunction
from jointfit_protocols.xcdi import XcdiIds
from jointfit_simulators.devices import (
    NS,
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    XbusDevice,
    XbusDeviceOptions,
    XcdiDevice,
    XcdiDeviceOptions,
)
from jointfit_simulators.scene._streams import ImuStream
from jointfit_simulators.wires import CanWire, PythonCanWire, SlcanAdapter, line_noise

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_simulators.devices import SampleTiming
    from jointfit_simulators.settings import Knobs

WIRES = {
    "S1": "xbus", "S2": "xcdi", "S3": "xbus", "S4": "xcdi", "S5": "xbus", "S6": "xcdi",
    "S7": "xbus", "S8": "xcdi", "S9": "xbus", "S10": "xcdi",
}  # fmt: skip
"""Default protocol of each sensor."""
BUS = "can0"
"""Name of the CAN bus in rig.toml and in commands."""
_EVERY_MESSAGE = 0xFFFF
"""Output rate of items in every message."""
_TAI_MINUS_UTC_S = 37
_SKIPPED_EDGES = 11
"""Exposures without a reported sync edge in between: ten edges per second at 120 Hz."""
_SYNC = (SyncSetting(SyncFunction.TRIGGER_INDICATION, IN1, Polarity.RISING, 0, 0, _SKIPPED_EDGES),)
_SYNC_TOML = (
    f'sync = [{{ function = "trigger_indication", line = "in1", skip_factor = {_SKIPPED_EDGES} }}]'
)
_ID_BLOCK = 0x100
"""Number of CAN identifiers for each sensor."""
_WIDE_BLOCKS = 7
"""Largest number of sensors whose blocks have 11-bit identifiers."""
_NARROW_BLOCK = 0x40
"""Number of CAN identifiers for each of more sensors."""


@dataclass
class SceneHardware:
    """Connected devices and their configuration tables."""

    streams: dict[str, ImuStream] = field(default_factory=dict)
    bus: CanWire | None = None
    tables: list[str] = field(default_factory=list)
    """``[[imu]]`` and ``[can.*]`` tables for rig.toml."""
    ports: dict[str, str] = field(default_factory=dict)
    """Port of each device or bus."""


def create_hardware(
    knobs: Knobs,
    sensors: Mapping[str, str],
    directory: Path,
    *,
    wires: Mapping[str, str],
    can: str,
    now_ns: int,
    sync_line: bool = False,
) -> SceneHardware:
    """Create and power the devices of a scene.

    Parameters
    ----------
    knobs
        Error magnitudes.
    sensors
        Segment of each sensor id.
    directory
        Directory of the symbolic links to the ptys.
    wires
        ``xbus`` or ``xcdi`` for each sensor.
    can
        ``slcan``, or INTERFACE:CHANNEL of python-can, such as ``socketcan:vcan0``.
    now_ns
        Host time of the start of the run, ns.
    sync_line
        Whether a sync line is connected; the Xbus devices are then configured to report its edges.
    """
    hardware = SceneHardware()
    for number, (name, segment) in enumerate(sensors.items(), start=1):
        device: XbusDevice | XcdiDevice
        if wires[name] == "xbus":
            port = directory / f"tty{name}"
            device = _xbus_device(knobs, name, port, _SYNC if sync_line else ())
            hardware.ports[name] = str(port)
            address = [f'port = "{port}"', "baud = 921600", *([_SYNC_TOML] if sync_line else [])]
        else:
            if hardware.bus is None:
                hardware.bus = _add_bus(hardware, knobs, directory, can)
            first = (_ID_BLOCK if len(sensors) <= _WIDE_BLOCKS else _NARROW_BLOCK) * number
            ids = XcdiIds(first + 0x05, first + 0x06, first + 0x21, status_word=None, error=None)
            device = XcdiDevice(hardware.bus, XcdiDeviceOptions(ids=ids, rate_hz=knobs.rate_hz))
            hardware.ports[name] = f"{BUS}:{ids.quaternion:#05x}"
            address = [f'can = "{BUS}"', ids_toml(ids)]

        on_uart = isinstance(device, XbusDevice)
        hardware.streams[name] = ImuStream(
            knobs,
            name,
            device,
            latency_ms=knobs.latency_uart_ms if on_uart else knobs.latency_can_ms,
            shared_wire=not on_uart,
            now_ns=now_ns,
        )
        head = [f'id = "{name}"', f'segment = "{segment}"', f'driver = "{wires[name]}"']
        rate = f"rate_hz = {knobs.rate_hz:g}"
        hardware.tables.append("\n".join(["[[imu]]", *head, *address, rate, ""]))
    return hardware


def ids_toml(ids: XcdiIds) -> str:
    """Return the line of rig.toml with the CAN identifiers of a sensor."""
    return (
        f"ids = {{ sample_time = {ids.sample_time:#05x}, group_counter = {ids.group_counter:#05x},"
        f" quaternion = {ids.quaternion:#05x} }}"
    )


def _xbus_device(knobs: Knobs, name: str, port: Path, sync: tuple[SyncSetting, ...]) -> XbusDevice:
    outputs = (
        (Item.PACKET_COUNTER, _EVERY_MESSAGE),
        (Item.SAMPLE_TIME_FINE, _EVERY_MESSAGE),
        (Item.STATUS_WORD, _EVERY_MESSAGE),
        (Item.QUATERNION, round(knobs.rate_hz)),
        *(((Item.TRIGGER_IN1, _EVERY_MESSAGE),) if sync else ()),
    )

    device_id = bytes([0x03, 0x60, 0xA1, *name.encode()[-1:]])
    return XbusDevice(
        port,
        options=XbusDeviceOptions(device_id=device_id, outputs=outputs, sync=sync),
        wire_noise=line_noise(knobs, name),
    )


def _add_bus(hardware: SceneHardware, knobs: Knobs, directory: Path, can: str) -> CanWire:
    interface, _, channel = can.partition(":")
    wire: CanWire
    if interface == "slcan":
        port = directory / "ttyCAN0"
        wire, channel = SlcanAdapter(port, wire_noise=line_noise(knobs, BUS)), str(port)
    else:
        try:
            wire = PythonCanWire(interface, channel)
        except OSError as error:
            raise ValueError(
                f"--can {can}: cannot open the interface ({error.strerror}): check that it exists"
                " and is up (ip link)"
            ) from error

    hardware.ports[BUS] = channel
    hardware.tables.append(f'[can.{BUS}]\ninterface = "{interface}"\nchannel = "{channel}"\n')
    return wire


def optical_server(
    knobs: Knobs,
    clusters: Mapping[str, tuple[str, ...]],
    bodies: Sequence[str],
    timing: SampleTiming,
    *,
    ptp: bool = False,
    command_port: int = 0,
) -> NatNetServer:
    """Return a NatNet server with one rigid body for each marker cluster.

    Parameters
    ----------
    knobs
        Camera rate and random seed.
    clusters
        Marker names of each body part.
    bodies
        Tracked rigid bodies; those without markers are last.
    timing
        Clock of the server.
    ptp
        Whether frames contain PTP precision timestamps.
    command_port
        UDP port on loopback for client commands; 0 selects a free port.
    """
    owned = {part.capitalize(): names for part, names in clusters.items()}
    owned |= {body: () for body in bodies if body not in owned}
    options = NatNetServerOptions(
        bodies=tuple(
            RigidBodyAsset(body, names, number)
            for number, (body, names) in enumerate(owned.items(), 1)
        ),
        command_port=command_port,
        rate_hz=knobs.mocap_hz,
        device_ns=timing.device_ns,
        seed=knobs.seed,
    )
    if ptp:
        # PTP counts TAI; its offset from the host clock is measured once
        offset_ns = time.time_ns() - time.monotonic_ns() + _TAI_MINUS_UTC_S * NS
        options = replace(
            options, bitstream=(4, 1), precision_ns=lambda host_ns: host_ns + offset_ns
        )
    return NatNetServer(options)


def mocap_table(server: NatNetServer, *, sync_line: bool = False) -> str:
    """Return the first lines of the ``[mocap]`` table for the server."""
    lines = [
        "[mocap]",
        'driver = "natnet"',
        'server = "127.0.0.1"',
        f"command_port = {server.command_port}",
        f'up_axis = "{server.options.up_axis}"',
    ]
    if sync_line:
        lines.append("sync_line = 0")
    if server.options.precision_ns is not None:
        lines.append('time = "ptp"')
    return "\n".join(lines)
