"""Lines of rig.toml for recognized devices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson

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
"""Driver of the kernel for devices that are on USB themselves, without a line of their own."""


def rig_lines(
    ports: Sequence[SerialPortInfo],
    serial: Sequence[SerialTraffic],
    can: Sequence[CanTraffic],
    servers: Sequence[FoundServer],
) -> str:
    """Return tables of rig.toml; names of sensors and segments are to be replaced."""
    tables = [*_buses(can), *_sensors(ports, serial, can), *_cameras(servers)]
    note = "# Replace id and segment: a segment of [chain] for each sensor.\n"
    return note + "\n".join(tables) if tables else ""


def _buses(can: Sequence[CanTraffic]) -> Iterator[str]:
    for traffic in can:
        if traffic.devices:
            # A bare key of TOML, otherwise one in quotes.
            interface = traffic.interface
            bare = interface.isascii() and interface.replace("_", "").replace("-", "").isalnum()
            name = interface if bare else _value(interface)
            keys = {"interface": "socketcan", "channel": traffic.interface}
            yield _table(f"[can.{name}]", keys)


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
    keys: dict[str, Any] = {
        "id": f"imu{number}",
        "segment": "SEGMENT",
        "driver": device.driver,
        **connection,
    }
    if device.usual_rate_hz is not None:
        keys["rate_hz"] = device.usual_rate_hz
    return _table("[[imu]]", keys)


def _cameras(servers: Sequence[FoundServer]) -> Iterator[str]:
    from jointfit_daemon.driver import find_driver

    for server in servers[:1]:  # a rig has one
        keys: dict[str, Any] = {"driver": server.driver, "server": server.server}

        # The command port, if it is not the default of the driver.
        field = find_driver(server.driver).Settings.model_fields.get("command_port")
        if field is not None and field.default != server.port:
            keys["command_port"] = server.port

        yield _table("[mocap]", keys) + "".join(
            f"# rigid_body.SEGMENT = {_value(name)}\n" for name in server.bodies
        )


def _table(header: str, keys: dict[str, Any]) -> str:
    return "".join([f"{header}\n", *(f"{key} = {_value(value)}\n" for key, value in keys.items())])


def _value(value: Any) -> str:
    """Return a value in TOML; its strings and numbers are those of JSON."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = 0x{number:X}' for key, number in value.items())} }}"
    return orjson.dumps(value).decode()
