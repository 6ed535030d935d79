"""Conversion of the recorded rig.toml to a rig.toml for the virtual devices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.files.text import toml_key, toml_value

if TYPE_CHECKING:
    from collections.abc import Mapping

_SECRETS = ("username", "password_file", "request_key_file", "tls", "insecure")
"""Keys of ``[mqtt]`` that apply to the broker of the recording only."""


def rig_for_devices(
    rig: Mapping[str, Any],
    *,
    ports: Mapping[str, str],
    buses: Mapping[str, str],
    command_port: int | None,
    broker: tuple[str, int],
) -> dict[str, Any]:
    """Return the parsed rig with the ports of the virtual devices and another broker.

    Parameters
    ----------
    rig
        Parsed rig.toml of the recording.
    ports
        Serial port of each device on a UART.
    buses
        Serial port of the adapter of each CAN bus.
    command_port
        UDP port of the motion-capture server on the loopback interface; None without a server.
    broker
        Host and port of the broker.
    """
    found: dict[str, Any] = dict(rig)
    found["imu"] = [
        {**imu, "port": ports[imu["id"]]} if imu["id"] in ports else imu for imu in rig["imu"]
    ]
    if buses:
        found["can"] = {
            name: {"interface": "slcan", "channel": port} for name, port in buses.items()
        }
    if command_port is not None:
        # This machine does not have the addresses of the recorded network.
        others = ("local", "interface", "local_address")
        mocap = {key: value for key, value in rig["mocap"].items() if key not in others}
        found["mocap"] = {**mocap, "server": "127.0.0.1", "command_port": command_port}
    mqtt = {key: value for key, value in rig.get("mqtt", {}).items() if key not in _SECRETS}
    found["mqtt"] = {**mqtt, "host": broker[0], "port": broker[1]}
    return found


def toml_text(table: Mapping[str, Any]) -> str:
    """Return a parsed TOML document as text; tables below the second level are inline."""
    plain = {key: value for key, value in table.items() if not _is_table(value)}
    parts = [_lines(plain)] if plain else []
    for key, value in table.items():
        if isinstance(value, dict):
            nested = {k: v for k, v in value.items() if key == "can" and isinstance(v, dict)}
            rest = {k: v for k, v in value.items() if k not in nested}
            if rest or not nested:
                parts.append(f"[{toml_key(key)}]\n{_lines(rest)}")
            parts += [f"[{toml_key(key)}.{toml_key(k)}]\n{_lines(v)}" for k, v in nested.items()]
        elif _is_table(value):
            parts += [f"[[{toml_key(key)}]]\n{_lines(item)}" for item in value]
    return "\n".join(parts)


def _is_table(value: object) -> bool:
    items = isinstance(value, list) and value and all(isinstance(one, dict) for one in value)
    return isinstance(value, dict) or bool(items)


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(
        f"{toml_key(key)} = {toml_value(value)}\n"
        for key, value in table.items()
        if value is not None
    )
