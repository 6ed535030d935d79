"""Virtual devices of a scene and their tables in rig.toml.

By default two sensors use UARTs (Xbus, one pty each) and two use CAN (XCDI, behind one SLCAN
adapter on a pty or on a python-can bus). The optical system is a NatNet server on loopback.
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
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from jointfit_simulators.devices import SampleTiming
    from jointfit_simulators.settings import Knobs

WIRES = {"S1": "xbus", "S2": "xcdi", "S3": "xbus", "S4": "xcdi"}
"""Default protocol of each sensor."""
BUS = "can0"
_FREE_RUNNING = 0xFFFF
_TAI_MINUS_UTC_S = 37
_EVERY = 12  # exposures per reported sync edge: ten edges a second at 120 Hz
_SYNC = (SyncSetting(SyncFunction.TRIGGER_INDICATION, IN1, Polarity.RISING, 0, 0, _EVERY - 1),)
_SYNC_TOML = (
    f'sync = [{{ function = "trigger_indication", line = "in1", skip_factor = {_EVERY - 1} }}]'
)
_FIRST_BLOCK = 0x100


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
        if wires[name] == "xbus":
            sync = _SYNC if sync_line else ()
            _on_uart(hardware, knobs, name, segment, directory=directory, now_ns=now_ns, sync=sync)
            continue
        if hardware.bus is None:
            hardware.bus = _bus(hardware, knobs, directory, can)
        _on_can(hardware, knobs, name, segment, number=number, now_ns=now_ns)
    return hardware


def _on_uart(
    hardware: SceneHardware,
    knobs: Knobs,
    name: str,
    segment: str,
    *,
    directory: Path,
    now_ns: int,
    sync: tuple[SyncSetting, ...],
) -> None:
    port = directory / f"tty{name}"
    outputs = (
        (Item.PACKET_COUNTER, _FREE_RUNNING),
        (Item.SAMPLE_TIME_FINE, _FREE_RUNNING),
        (Item.STATUS_WORD, _FREE_RUNNING),
        (Item.QUATERNION, round(knobs.rate_hz)),
        *(((Item.TRIGGER_IN1, _FREE_RUNNING),) if sync else ()),
    )
    identity = bytes([0x03, 0x60, 0xA1, *name.encode()[-1:]])
    device = XbusDevice(
        port,
        options=XbusDeviceOptions(device_id=identity, outputs=outputs, sync=sync),
        wire_noise=line_noise(knobs, name),
    )
    hardware.streams[name] = ImuStream(
        knobs, name, device, latency_ms=knobs.latency_uart_ms, shared_wire=False, now_ns=now_ns
    )
    hardware.ports[name] = str(port)
    where = [f'port = "{port}"', "baud = 921600", *([_SYNC_TOML] if sync else [])]
    hardware.tables.append(_imu_table(knobs, name, segment, "xbus", where))


def _bus(hardware: SceneHardware, knobs: Knobs, directory: Path, can: str) -> CanWire:
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
                f"--can {can}: cannot be opened ({error.strerror}): is the interface there, and up"
                " (ip link)?"
            ) from error
    hardware.ports[BUS] = channel
    hardware.tables.append(f'[can.{BUS}]\ninterface = "{interface}"\nchannel = "{channel}"\n')
    return wire


def _on_can(
    hardware: SceneHardware, knobs: Knobs, name: str, segment: str, *, number: int, now_ns: int
) -> None:
    if hardware.bus is None:
        raise ValueError("no bus to put a CAN device on")
    block = _FIRST_BLOCK * number
    ids = XcdiIds(block + 0x05, block + 0x06, block + 0x21, status_word=None, error=None)
    device = XcdiDevice(hardware.bus, XcdiDeviceOptions(ids=ids, rate_hz=knobs.rate_hz))
    hardware.streams[name] = ImuStream(
        knobs, name, device, latency_ms=knobs.latency_can_ms, shared_wire=True, now_ns=now_ns
    )
    hardware.ports[name] = f"{BUS}:{ids.quaternion:#05x}"
    numbers = (
        f"sample_time = {ids.sample_time:#05x}, group_counter = {ids.group_counter:#05x}, "
        f"quaternion = {ids.quaternion:#05x}"
    )
    hardware.tables.append(
        _imu_table(knobs, name, segment, "xcdi", [f'can = "{BUS}"', f"ids = {{ {numbers} }}"])
    )


def _imu_table(knobs: Knobs, name: str, segment: str, driver: str, where: list[str]) -> str:
    head = ["[[imu]]", f'id = "{name}"', f'segment = "{segment}"', f'driver = "{driver}"']
    return "\n".join([*head, *where, f"rate_hz = {knobs.rate_hz:g}", ""])


def optical_server(
    knobs: Knobs,
    clusters: Mapping[str, tuple[str, ...]],
    bodies: Sequence[str],
    ticker: SampleTiming,
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
    ticker
        Clock of the server.
    ptp
        Whether frames carry PTP precision timestamps.
    command_port
        UDP port on loopback for client commands; 0 selects a free port.
    """
    owned = {part.capitalize(): names for part, names in clusters.items()}
    owned |= {body: () for body in bodies if body not in owned}
    staged = tuple(
        RigidBodyAsset(body, names, number) for number, (body, names) in enumerate(owned.items(), 1)
    )
    options = NatNetServerOptions(
        bodies=staged,
        command_port=command_port,
        rate_hz=knobs.mocap_hz,
        device_ns=ticker.device_ns,
        seed=knobs.seed,
    )
    if ptp:
        options = replace(options, bitstream=(4, 1), precision_ns=_ptp_time())
    return NatNetServer(options)


def _ptp_time() -> Callable[[int], int]:
    """Return the conversion from host time to PTP time (TAI), with the offset measured now."""
    ahead_ns = time.time_ns() - time.monotonic_ns() + _TAI_MINUS_UTC_S * NS
    return lambda host_ns: host_ns + ahead_ns


def mocap_table(server: NatNetServer, *, sync_line: bool = False) -> str:
    """Return the first lines of the ``[mocap]`` table for the server."""
    wired = "\nsync_line = 0" if sync_line else ""
    wired += '\ntime = "ptp"' if server.options.precision_ns is not None else ""
    where = f'server = "127.0.0.1"\ncommand_port = {server.command_port}'
    return f'[mocap]\ndriver = "natnet"\n{where}\nup_axis = "{server.options.up_axis}"{wired}'
