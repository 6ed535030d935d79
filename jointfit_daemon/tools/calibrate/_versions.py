"""Options ``--list``, ``--use`` and ``--revert`` of `jointfit calibrate`: stored calibrations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import orjson
import typer

from jointfit_daemon.tools.request import exit_if_refused, send_request
from jointfit_daemon.tools.text_output import align_columns

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


def list_versions(config: Path, *, json: bool) -> None:
    """Print the stored calibrations, newest first; ``*`` marks the active calibration."""
    answer = send_request(config, "calibrations", {})
    exit_if_refused(answer)
    data: Mapping[str, Any] = answer["data"]
    if json:
        typer.echo(orjson.dumps(data))
        return
    if not data["versions"]:
        typer.echo(f"store {data['store']!r} has no calibration: jointfit calibrate creates one")
        return

    rows = [("", "version", "date (UTC)", "method", "held-out error", "note")]
    for version in data["versions"]:
        in_force = "*" if version["version"] == data["in_force"] else ""
        date = (version["created_utc"] or "unknown")[:19]

        found = {**version["segments_deg"], **version["flexion_deg"]}
        shown = [f"{name} {error:.1f}°" for name, error in found.items() if error is not None]
        rows.append(
            (
                in_force, str(version["version"]), date, version["method"] or "–",
                ", ".join(shown) or "–", _note(version),
            )
        )  # fmt: skip
    typer.echo(align_columns(rows, right=(1,)))
    if data["omitted"]:
        typer.echo(f"and {data['omitted']} older versions")


def use_version(config: Path, version: int | None, *, json: bool) -> None:
    """Activate a stored version; None selects the version before the active version."""
    arguments = {"revert": True} if version is None else {"version": version}
    answer = send_request(config, "use-calibration", arguments)
    exit_if_refused(answer)
    data: Mapping[str, Any] = answer["data"]
    typer.echo(orjson.dumps(data) if json else f"version {data['version']} is in force")


def _note(version: Mapping[str, Any]) -> str:
    if version["fault"]:
        return str(version["fault"])
    if not version["usable"]:
        return "made for another limb or other sensors"
    notes = [f"copy of version {version['restored_from']}"] if version["restored_from"] else []
    if (online := version["online"]) is not None:
        notes.append(f"online learning, round {online['rounds']}")
    if not notes and not version["functional"]:
        notes.append("static pose only")
    return ", ".join(notes)
