"""Conversion of a rig to the text of a rig.toml with comments.

Invariant: a TOML parser reads the original table from the text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.files.text import toml_key, toml_value

if TYPE_CHECKING:
    from collections.abc import Mapping

_COLUMN = 42
"""Text column at which the comments after keys begin."""

_HEADER = """\
# Rig of jointfitd, written by `jointfit init`. You may edit it: `jointfit check` reports all
# faults, `jointfit schema` prints all keys with their units and defaults.
"""
_COMMENTS = {
    "rig.name": "becomes part of every MQTT topic",
    "rig.output_rate_hz": "poses per second",
    "chain.joints": "from proximal to distal",
    "chain.proximal": "body part with markers only",
    "chain.distal": "body part with markers only",
    "chain.lengths_m": "m, from joint to joint",
    "chain.motion": "cameras alone follow a movement in a plane",
    "mocap.server": "computer of the motion-capture system",
    "mocap.up_axis": "vertical axis of the stream",
    "mocap.plate": "rigid body with all sensors in the align phase",
    "calibration.store": "folder of the calibrations, one file per version",
    "mqtt.password_file": "readable by its owner only",
    "mqtt.sensors_hz": "for the check of axes in the dashboard",
    "mqtt.insecure": "any computer on the network path can read and send",
}
_HEXADECIMAL = "ids"
"""Name of the table whose numbers are CAN identifiers."""


def rig_text(table: Mapping[str, Any]) -> str:
    """Return the text of a rig.toml."""
    parts = [_HEADER]
    for name, content in table.items():
        if name == "imu":
            parts += [_section("[[imu]]", sensor, "imu") for sensor in content]
        elif name == "can":
            parts += [_section(f"[can.{bus}]", keys, "can") for bus, keys in content.items()]
        else:
            parts.append(_section(f"[{name}]", content, name))
    return "\n".join(parts)


def _section(header: str, content: Mapping[str, Any], name: str) -> str:
    lines, tables = [header], []
    for key, value in content.items():
        if key == "markers":
            lines += [
                f"markers.{toml_key(part)} = {toml_value(names)}" for part, names in value.items()
            ]
        elif key == "tls":
            tables.append(_section(f"[{name}.tls]", value, f"{name}.tls"))
        elif key == "joint":
            tables += [_section(f"[[{name}.joint]]", joint, f"{name}.joint") for joint in value]
        else:
            line = f"{key} = {toml_value(value, hexadecimal=key == _HEXADECIMAL)}"
            comment = _COMMENTS.get(f"{name}.{key}")
            lines.append(f"{line:{_COLUMN - 1}} # {comment}" if comment else line)
    return "\n".join(["\n".join(lines) + "\n", *tables])
