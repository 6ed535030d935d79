"""Lines of rig.toml for recognized devices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.files.text import toml_key, toml_value

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_daemon.tools.discovery import (
        CanTraffic,
        DecodedDevice,
        FoundServer,
        SerialPortInfo,
        SerialTraffic,
    )

_USB_SERIAL = "cdc_acm"
"""Kernel driver of sensors with their own USB interface. They have no serial line and no line
speed."""


def rig_lines(
    ports: Sequence[SerialPortInfo],
    serial: Sequence[SerialTraffic],
    can: Sequence[CanTraffic],
    servers: Sequence[FoundServer],
) -> str:
    """Return tables for rig.toml, in which the user replaces the sensor and segment names."""
    names = [traffic.interface for traffic in can if traffic.devices]
    buses = [
        _table(f"[can.{toml_key(name)}]", {"interface": "socketcan", "channel": name})
        for name in names
    ]
    tables = [*buses, *_sensors(ports, serial, can), *_cameras(servers)]
    note = "# Replace each id, and replace each segment by a segment of [chain].\n"
    return note + "\n".join(tables) if tables else ""


def _sensors(
    ports: Sequence[SerialPortInfo], serial: Sequence[SerialTraffic], can: Sequence[CanTraffic]
) -> Iterator[str]:
    from jointfit_daemon.driver import find_driver

    number = 0
    for traffic in serial:
        for device in traffic.devices[:1]:
            number += 1

            name = Path(traffic.port).resolve().name
            info = next((port for port in ports if Path(port.device).name == name), None)
            keys: dict[str, Any] = {"port": traffic.port if info is None else info.path}
            keys |= device.settings
            fields = find_driver(device.driver).Settings.model_fields
            if info is not None and info.driver == _USB_SERIAL and "transport" in fields:
                keys["transport"] = "usb"
            yield _imu(number, device, keys)
    for bus in can:
        for device in bus.devices:
            number += 1
            yield _imu(number, device, {"can": bus.interface, **device.settings})


def _imu(number: int, device: DecodedDevice, connection: dict[str, Any]) -> str:
    from jointfit_daemon.driver import find_driver

    keys: dict[str, Any] = {
        "id": f"imu{number}",
        "segment": "SEGMENT",
        "driver": device.driver,
        **connection,
    }
    if device.usual_rate_hz is not None:
        keys["rate_hz"] = device.usual_rate_hz

    # Required keys of the driver that the received data do not contain.
    fields = find_driver(device.driver).Settings.model_fields
    missing = [key for key, field in fields.items() if field.is_required() and key not in keys]
    return _table("[[imu]]", keys) + "".join(
        f"# add {key}: {fields[key].description}\n" for key in missing
    )


def _cameras(servers: Sequence[FoundServer]) -> Iterator[str]:
    from jointfit_daemon.driver import find_driver

    for server in servers[:1]:  # a rig has one camera system
        keys: dict[str, Any] = {
            "driver": server.driver,
            "server": server.server,
            **server.settings,
        }

        # Write the command port if it differs from the driver's default.
        field = find_driver(server.driver).Settings.model_fields.get("command_port")
        if field is not None and field.default != server.port:
            keys["command_port"] = server.port

        yield _table("[mocap]", keys) + "".join(
            f"# rigid_body.SEGMENT = {toml_value(name)}\n" for name in server.bodies
        )


def _table(header: str, keys: dict[str, Any]) -> str:
    lines = [
        f"{key} = {toml_value(value, hexadecimal=key == 'ids')}" for key, value in keys.items()
    ]
    return "\n".join([header, *lines, ""])
