"""Result of `jointfit probe`, and its conversion to text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic.dataclasses import dataclass

from jointfit_daemon.tools.discovery import (
    CanChannel,
    CanInterface,
    CanTraffic,
    DecodedDevice,
    FoundServer,
    SerialPortInfo,
    SerialTraffic,
)
from jointfit_daemon.tools.text_output import align_columns

if TYPE_CHECKING:
    from collections.abc import Iterator


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """Devices of this host, and the results of the requested receptions."""

    serial_ports: list[SerialPortInfo]
    can_interfaces: list[CanInterface]
    can_channels: list[CanChannel]
    """Buses in the configuration files of python-can."""
    serial: list[SerialTraffic]
    """Results of the reception on the ports of ``--serial``."""
    can: list[CanTraffic]
    """Results of the reception on the interfaces of ``--can``."""
    mocap_servers: list[FoundServer]
    """Servers that answered the requests of ``--mocap`` or ``--network``."""
    faults: list[str]
    """Error texts about requests without a result, each with a remedy."""
    rig_toml: str
    """Lines for rig.toml; empty if nothing was recognized."""


def report_lines(report: ProbeReport) -> Iterator[str]:
    """Yield the lines of text of a report."""
    yield "Serial ports"
    rows = [(port.path, port.device, port.description) for port in report.serial_ports]
    yield _table(rows, "none: plug an adapter in, and read the kernel log (`dmesg`)")

    yield "\nCAN interfaces"
    rows = []
    for each in report.can_interfaces:
        bitrate = f"{each.bitrate} bit/s" if each.bitrate else None
        words = ("up" if each.up else "down", bitrate, each.state, each.driver)
        rows.append((each.name, each.kind, ", ".join(filter(None, words))))
    rows += [(channel.channel, channel.interface, channel.file) for channel in report.can_channels]
    yield _table(rows, "none: plug an adapter in, or load its module (virtual: vcan)")

    for serial in report.serial:
        yield f"\n{serial.port}: {_serial_result(serial)}"
        yield from _device_lines(serial.devices)
    for can in report.can:
        if can.fault is None:
            errors = f", {can.error_frames} error frames" if can.error_frames else ""
            yield f"\n{can.interface}: {len(can.identifiers)} identifiers{errors}"
            yield from _identifier_lines(can)
            yield from _device_lines(can.devices)

    if report.mocap_servers:
        yield "\nMotion-capture servers"
    for server in report.mocap_servers:
        yield (
            f"  {server.server}:{server.port}  {server.application} {server.version}, "
            f"{server.protocol}, {server.transport}, at {server.interface}"
        )
        if server.bodies or server.markers:
            yield f"    rigid bodies: {', '.join(server.bodies) or 'none'}"
            yield f"    markers: {', '.join(server.markers) or 'none'}"

    if report.rig_toml:
        yield f"\nLines for rig.toml:\n\n{report.rig_toml.rstrip()}"


def _table(rows: list[tuple[str, str, str]], empty: str) -> str:
    text = align_columns(rows) if rows else empty
    return "\n".join(f"  {line}" for line in text.splitlines())


def _serial_result(serial: SerialTraffic) -> str:
    if serial.fault is not None:
        return "not opened"
    if serial.baud is not None:
        return f"{serial.baud} baud"
    speeds = ", ".join(map(str, serial.received_bytes))
    if not any(serial.received_bytes.values()):
        return f"silent at {speeds} baud"
    return f"{sum(serial.received_bytes.values())} bytes, no known format at {speeds} baud"


def _device_lines(devices: tuple[DecodedDevice, ...]) -> Iterator[str]:
    for device in devices:
        model = device.properties.get("model")
        rate = "no orientations" if device.rate_hz is None else f"{device.rate_hz:.1f} Hz"
        ids = device.settings.get("ids") or {}
        words = [f"{name} 0x{number:X}" for name, number in ids.items()]

        yield "  " + ", ".join(
            [
                f"{device.driver}{f' ({model})' if model else ''}: {rate}",
                f"{device.messages} messages",
                f"{device.discarded_bytes} bytes skipped",
                *words,
            ]
        )
        for warning in device.warnings:
            yield f"    warning: {warning}"


def _identifier_lines(traffic: CanTraffic) -> Iterator[str]:
    rows = [
        (
            f"0x{each.id:0{8 if each.extended else 3}X}",
            f"{each.data_bytes} bytes",
            "–" if each.rate_hz is None else f"{each.rate_hz:.1f} Hz",
            each.driver or "unknown",
        )
        for each in traffic.identifiers
    ]
    if rows:
        yield "\n".join(f"  {line}" for line in align_columns(rows, right={2}).splitlines())
