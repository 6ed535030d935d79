"""Completions that a shell offers at the Tab key, for each type of argument.

The module that provides a list is imported only when a shell requests the list, because most lists
need the packages of the daemon.
"""

from __future__ import annotations

import glob
from pathlib import Path
from typing import TYPE_CHECKING

import typer  # noqa: TC002 - typer reads the annotations

if TYPE_CHECKING:
    from collections.abc import Iterable


def complete_rig_or_command(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the rig files and the second words of command names that begin with `incomplete`.

    If no second word matches, the result is empty and the shell completes paths.
    """
    group = getattr(ctx.parent, "command", None)
    names = [name.split(" ") for name in getattr(group, "commands", {}) if " " in name]
    words = _beginning_with(incomplete, [two[1] for two in names if two[0] == ctx.info_name])
    return [*words, *glob.glob(f"{glob.escape(incomplete)}*.toml")] if words else []  # noqa: PTH207 - as typed


def complete_sensor(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the sensor ids that begin with `incomplete`; none if the rig cannot be read."""
    from jointfit_daemon.files.text import parse_toml

    try:
        table = parse_toml(Path(ctx.params.get("rig") or "rig.toml").read_text(encoding="utf-8"))
        return _beginning_with(incomplete, [str(imu["id"]) for imu in table["imu"]])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return []


def complete_driver(incomplete: str) -> list[str]:
    """Return the installed drivers that begin with `incomplete`."""
    from jointfit_daemon.driver import driver_names

    return _beginning_with(incomplete, driver_names())


def complete_request(incomplete: str) -> list[str]:
    """Return the names of requests that begin with `incomplete`."""
    from jointfit_daemon.supervisor.requests import REQUESTS

    return _beginning_with(incomplete, REQUESTS)


def complete_serial_port(incomplete: str) -> list[str]:
    """Return the paths of serial ports that begin with `incomplete`."""
    from jointfit_daemon.tools.discovery import find_serial_ports

    ports = find_serial_ports()
    return _beginning_with(incomplete, [path for p in ports for path in (p.path, p.device)])


def complete_can_interface(incomplete: str) -> list[str]:
    """Return the CAN interfaces that begin with `incomplete`."""
    from jointfit_daemon.tools.discovery import find_can_interfaces

    return _beginning_with(incomplete, [interface.name for interface in find_can_interfaces()])


def complete_topic(incomplete: str) -> list[str]:
    """Return the topics and requests with a JSON Schema that begin with `incomplete`."""
    from jointfit_daemon.outputs.payload_models import PAYLOADS
    from jointfit_daemon.supervisor.requests import REQUESTS

    requests = (f"bridge/request/{name}" for name in REQUESTS)
    return _beginning_with(incomplete, [*(topic.pattern for topic in PAYLOADS), *requests])


def _beginning_with(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
