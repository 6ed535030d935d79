"""Virtual devices of a scene and their tables in rig.toml.

By default, every second sensor uses a UART (Xbus, one pseudo-terminal each). The other sensors use
CAN (XCDI), on an SLCAN adapter with a pseudo-terminal or on a python-can bus. The optical system is
a NatNet server on the loopback interface. The families of devices are in `_imu_families` and
`_mocap_families`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_simulators.scene._imu_families import BUS, IMU_FAMILIES, CanFamily, SensorPlace
from jointfit_simulators.scene._opened_port import OpenedPort
from jointfit_simulators.scene._streams import ImuStream
from jointfit_simulators.wires import CanWire, PythonCanWire, SlcanAdapter, line_noise

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_simulators.settings import Knobs

WIRES = {
    "S1": "xbus", "S2": "xcdi", "S3": "xbus", "S4": "xcdi", "S5": "xbus", "S6": "xcdi",
    "S7": "xbus", "S8": "xcdi", "S9": "xbus", "S10": "xcdi",
}  # fmt: skip
"""Default driver of each sensor."""


@dataclass
class SceneHardware:
    """Connected devices and their configuration tables."""

    streams: dict[str, ImuStream] = field(default_factory=dict)
    bus: CanWire | None = None
    tables: list[str] = field(default_factory=list)
    """``[[imu]]`` and ``[can.*]`` tables for rig.toml."""
    ports: dict[str, str] = field(default_factory=dict)
    """Port of each device or bus, by name."""


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
    """Create the devices of a scene and their tables in rig.toml.

    Parameters
    ----------
    knobs
        Settings with the magnitudes of all errors.
    sensors
        Segment of each sensor, by sensor id.
    directory
        Directory of the symbolic links to the pseudo-terminals.
    wires
        Family of each sensor, from `IMU_FAMILIES`.
    can
        ``slcan``, or INTERFACE:CHANNEL of python-can, such as ``socketcan:vcan0``.
    now_ns
        Host time at the start of the run, ns.
    sync_line
        Whether a sync line is connected. Devices with a sync input are then configured to report
        its edges.
    """
    hardware = SceneHardware()
    for number, (name, segment) in enumerate(sensors.items(), start=1):
        family = IMU_FAMILIES[wires[name]]
        on_can = isinstance(family, CanFamily)
        place = SensorPlace(knobs, name, number, len(sensors), sync_line)
        if isinstance(family, CanFamily):
            if hardware.bus is None:
                hardware.bus = _add_bus(hardware, knobs, directory, can)
            imu = family.create(place, hardware.bus)
        else:
            imu = family.create(place, directory / f"tty{name}")

        hardware.ports[name] = imu.label
        hardware.streams[name] = ImuStream(
            knobs,
            name,
            imu.device,
            latency_ms=knobs.latency_can_ms if on_can else knobs.latency_uart_ms,
            shared_wire=on_can,
            now_ns=now_ns,
            port=None if on_can else OpenedPort(directory / f"tty{name}"),
        )
        driver = family.driver or wires[name]
        head = [f'id = "{name}"', f'segment = "{segment}"', f'driver = "{driver}"']
        rate = f"rate_hz = {knobs.rate_hz:g}"
        # The rate precedes the keys of a family, because these keys may end with a table.
        hardware.tables.append("\n".join(["[[imu]]", *head, rate, *imu.keys, ""]))
    return hardware


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
