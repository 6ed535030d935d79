"""Frame layouts in an existing rig.toml, for devices without their own driver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.files.text import parse_toml

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.discovery import Layouts

_CONNECTION = ("id", "segment", "driver", "port", "can", "baud", "transport", "silence_s")
"""Keys of ``[[imu]]`` that do not describe the data of a device."""


def described_layouts(rig: Path) -> Layouts:
    """Return the layouts in a rig, by driver; none if the rig cannot be read.

    The command `jointfit check` reports the faults of the rig.
    """
    try:
        imus = parse_toml(rig.read_text(encoding="utf-8")).get("imu", [])
    except (OSError, ValueError, RecursionError):
        return {}
    found: dict[str, list[dict[str, Any]]] = {}
    for imu in imus if isinstance(imus, list) else ():
        if not isinstance(imu, dict) or not isinstance(imu.get("fields"), dict):
            continue
        layout = {key: value for key, value in imu.items() if key not in _CONNECTION}
        if isinstance(layout.get("dbc"), str):
            layout["dbc"] = str(rig.absolute().parent / layout["dbc"])
        known = found.setdefault(str(imu.get("driver")), [])
        if layout not in known:
            known.append(layout)
    return found
